"""The training loop of all methods: step, log, save now and then, and resume where an earlier one stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from sarsplat.data import Dataset, new_folder, write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import only_writer, refuse_existing
from sarsplat.errors import SarsplatError
from sarsplat.progress import Reporter
from sarsplat.reconstruction.config import AnyConfig, refuse_other_settings
from sarsplat.reconstruction.log import LogLine, log_text
from sarsplat.reconstruction.method import Trainable
from sarsplat.reconstruction.run import HEADER, InMemory, Run, require_replaceable
from sarsplat.reconstruction.snapshot import Snapshot

_LINES_PER_RUN = 200
"""About how many lines `metrics.jsonl` gets."""

_SECONDS_UNSEEN = 5.0
"""The progress is shown at least this often, if steps are not longer."""

_CHECKPOINTS_KEPT = 2


T = TypeVar("T", bound=Trainable)


@dataclass(frozen=True)
class Step(Generic[T]):
    """What is passed to a watcher of a training after each step.

    Parameters
    ----------
    iteration : int
        Steps done, this one included.
    loss : Tensor
        Its loss, a single number; reading it waits for the device.
    trainer : Trainable
        The training itself, between two steps; that of `sar-gs` has the target as it is now, `trainer.gaussians`.
    line : LogLine or None
        The line that the log gets after this step; None after most.
    folder_to_come : Path or None
        The run's folder as long as it is being built elsewhere, which is until after the first checkpoint: nothing may
        be written there yet. Then, and for a run in memory, None.
    """

    iteration: int
    loss: Tensor
    trainer: T
    line: LogLine | None = None
    folder_to_come: Path | None = None


class Training(Generic[T]):
    """A trainer at work: counts the time, calls whoever watches, and keeps the log."""

    def __init__(self, trainer: T, on_step: Callable[[Step[T]], object] | None, shown: Reporter) -> None:
        self.trainer, self.shown, self._on_step = trainer, shown, on_step
        self.history: list[LogLine] = []
        self.between_steps = True
        self.ended = False  # by whoever watches
        self.folder_to_come: Path | None = None
        self._begun = self._shown_at = time.monotonic()

    @property
    def seconds(self) -> float:
        """Time trained so far, s of wall clock."""
        return time.monotonic() - self._begun

    def start_from(self, snapshot: Snapshot, history: list[LogLine]) -> None:
        """Resume from a state, and the log that led there."""
        self.trainer.restore(snapshot)
        self._begun -= snapshot.seconds
        self.history = [line for line in history if line.iteration <= snapshot.iteration]  # a killed process wrote more
        self.shown.start_at(snapshot.iteration)

    def go_on_to(
        self, iterations: int, log: Callable[[LogLine], object] | None = None, save: Callable[[], object] | None = None
    ) -> None:
        """Step until so many iterations are done; `log` each line, and `save` whenever the configuration says so."""
        trainer, config = self.trainer, self.trainer.config
        every = max(1, config.iterations // _LINES_PER_RUN)
        losses: list[Tensor] = []
        while trainer.iteration < iterations:
            self.between_steps = False
            loss = trainer.step()
            losses.append(loss)
            logs = trainer.iteration % every == 0 or trainer.iteration == config.iterations
            saves = save is not None and trainer.iteration % config.checkpoint_every == 0
            if logs or saves:
                trainer.check()  # as a part of the step: what is wrong is not saved
            line = self._line(losses) if logs else None
            self.between_steps = True
            if line is not None:
                losses = []
                self.history.append(line)
                self._show(line.loss)
                if log is not None:
                    log(line)
            elif time.monotonic() - self._shown_at > _SECONDS_UNSEEN:
                self._show(loss.item())
            if save is not None and saves:
                save()
            if self._on_step is not None:
                step = Step(trainer.iteration, loss, trainer, line, self.folder_to_come)
                if self._on_step(step) is True:
                    self.ended = True
                    return

    def _show(self, loss: float) -> None:
        count = self.trainer.gaussian_count
        self.shown.update(
            self.trainer.iteration, f"loss {loss:.3g}" + ("" if count is None else f"  {count} Gaussians")
        )
        self._shown_at = time.monotonic()

    def _line(self, losses: list[Tensor]) -> LogLine:
        loss = sum(torch.stack(losses).tolist()) / len(losses)  # one wait for the device
        if not math.isfinite(loss):
            raise SarsplatError(
                f"the loss became {loss} at iteration {self.trainer.iteration}; lower the learning rates (the last "
                "checkpoint is from before)"
            )
        return LogLine(self.trainer.iteration, round(self.seconds, 3), loss, self.trainer.gaussian_count)


def train(
    training: Training[Any], new: Run, dataset: Dataset, out: Path | None, *, resume: bool, overwrite: bool
) -> Run:
    """Train to the end, in memory or, with `out`, in a folder from which it can be resumed at any time.

    Parameters
    ----------
    training : Training
        At its beginning; to resume, it is brought to where it stopped.
    new : Run
        The run as it will be: settings and fingerprint of the dataset.
    dataset : Dataset
        Its images.
    out : Path or None
        Its folder.
    resume, overwrite : bool
        Whether the folder holds this run, or may hold another.

    Raises
    ------
    SarsplatError
        If `out` exists (to resume: does not), another process is writing it, or dataset or settings are not those the
        run was started with.
    """
    if resume and overwrite:
        raise SarsplatError("a run is either resumed or overwritten; give only one of resume and overwrite")
    if out is not None:
        return _on_the_disk(training, new, dataset, out, resume, overwrite)
    if resume or overwrite:
        raise SarsplatError("a run in memory can be neither resumed nor overwritten; pass a folder as `out`")
    training.go_on_to(training.trainer.config.iterations)
    held = InMemory(training.trainer.snapshot(training.seconds), tuple(training.history))
    return replace(new, memory=held, images=dataset)


def _on_the_disk(training: Training[Any], new: Run, dataset: Dataset, out: Path, resume: bool, overwrite: bool) -> Run:
    config = training.trainer.config
    stopped: BaseException | None = None
    if resume:
        begun = Run.load(out)
    else:
        if overwrite:
            require_replaceable(out)
        refuse_existing(out, overwrite, marker=HEADER)
    with only_writer(out):
        if resume:
            _resume(training, begun, dataset)
        else:
            with new_folder(out, overwrite, marker=HEADER) as folder:
                run = new.placed(folder, dataset)
                training.folder_to_come = out
                try:
                    _train(training, run, min(config.checkpoint_every, config.iterations))
                except BaseException as error:
                    if run.checkpoint_path is None:
                        raise
                    if (out / HEADER).is_file():
                        if not isinstance(error, KeyboardInterrupt):
                            raise
                        raise KeyboardInterrupt(
                            f"stopped before the first checkpoint; {out} is still as it was"
                        ) from error
                    stopped = error
            training.folder_to_come = None
        try:
            if stopped is None and not training.ended:
                _train(training, Run.load(out), config.iterations)
        finally:  # the run is usable as far as it has come
            finished = replace(Run.load(out), images=dataset)
            if finished.checkpoint_path is not None:
                training.shown.note("extracting the surface: points and normals")
                finished.write_results()
    if stopped is not None:
        raise stopped
    return finished


def _resume(training: Training[Any], run: Run, dataset: Dataset) -> None:
    """Bring the training to a run's newest checkpoint."""
    config = training.trainer.config
    if run.fingerprint != dataset.fingerprint():
        raise SarsplatError(
            f"{run.path} was started with another dataset ({run.dataset_path}); resume it with that one"
        )
    refuse_other_settings(run.folder, run.config, config)
    if run.checkpoint_path is not None and run.iteration > config.iterations:
        raise SarsplatError(
            f"{run.path} has already done {run.iteration} iterations, more than {config.iterations}; resume it with at "
            f"least {run.iteration}"
        )
    other_results = any(name not in AnyConfig.may_change for name, _, _ in run.config.changes(config))
    run = run.resumed(dataset, config)
    if run.checkpoint_path is not None:
        snapshot = run.snapshot
        try:
            training.start_from(snapshot, run.history)
        except (LookupError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise SarsplatError(
                f"{run.checkpoint_path} does not match this version ({error}); start again with --overwrite"
            ) from error
    if other_results or training.trainer.iteration < config.iterations:
        run.remove_results()
    write_bytes(run.log_path, log_text(training.history))


def _train(training: Training[Any], run: Run, iterations: int) -> None:
    """Train on, log and save; whatever ends it between two steps, what has been learned is saved."""
    trainer = training.trainer

    def log(line: LogLine) -> None:
        with plain_os_errors("write", run.log_path), run.log_path.open("ab") as file:
            file.write(log_text([line]))

    def save() -> None:
        folder = run.log_path.parent / "checkpoints"
        trainer.snapshot(training.seconds).save(folder / f"{trainer.iteration:08d}.safetensors")
        with plain_os_errors("write", folder):
            for old in sorted(folder.glob("*.safetensors"))[:-_CHECKPOINTS_KEPT]:
                old.unlink()

    done = trainer.iteration
    try:
        training.go_on_to(iterations, log, save)
    finally:
        if training.between_steps and trainer.iteration > done and trainer.iteration % trainer.config.checkpoint_every:
            save()
