"""Training loop of all methods: steps, log, checkpoints and resuming."""

import math
import threading
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
from sarsplat.learning.method import Trainable
from sarsplat.progress import Reporter
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import ABOUT, HEADER, InMemory, LogLine, RunFolder, log_text, require_replaceable
from sarsplat.settings.config import AnyConfig, refuse_other_settings

_LOG_LINES = 200  # approximate number of lines of `metrics.jsonl`
_UPDATE_S = 5.0  # maximum interval between progress updates, unless a step takes longer
_TRIAL_EVERY = 100  # steps between trials of thread counts: the load of the machine and the size of images change
_TRIAL_STEPS = 2  # steps of a trial with each number of threads; the quickest counts
_MAX_SLOWDOWN = 1.5  # time of a step relative to the quickest above which more threads are not tried

M = TypeVar("M")
T = TypeVar("T", bound=Trainable)


@dataclass(frozen=True)
class Step(Generic[T]):
    """State after a step, the argument of `on_step`."""

    iteration: int
    """Iterations done, this one included."""
    loss: Tensor
    """Loss, a scalar; reading it waits for the device."""
    trainer: T
    """Trainer between two steps; `trainer.gaussians` is the current target of `sar-gs`."""
    line: LogLine | None = None
    """New line of the log; None after most steps."""
    folder_to_come: Path | None = None
    """Final folder of the run until it appears with the first checkpoint: nothing may be written there before. None
    afterwards, and in memory."""
    last: bool = False
    """True if it is the last step of this process."""


class Training(Generic[T]):
    """Loop around a trainer that measures time, calls `on_step` and writes log and checkpoints.

    `run` has the folder of log and checkpoints; None in memory. `ended` is True after `on_step` has returned True.
    """

    def __init__(self, trainer: T, on_step: Callable[[Step[T]], object] | None, shown: Reporter) -> None:
        self.trainer, self.shown, self._on_step = trainer, shown, on_step
        self.history: list[LogLine] = []
        self.run: Run | None = None
        self.ended = False
        self.folder_to_come: Path | None = None
        self._between_steps = True
        self._begun = self._shown_at = time.monotonic()

    @property
    def seconds(self) -> float:
        """Training time so far, wall clock, s."""
        return time.monotonic() - self._begun

    @property
    def last(self) -> bool:
        """True if the last step was the final one of this process."""
        return self.trainer.iteration >= self.trainer.config.iterations

    def resume(self, dataset: Dataset) -> None:
        """Restore trainer, log and folder to the newest checkpoint of `run`."""
        run, config = self.run, self.trainer.config
        assert run is not None
        if run.fingerprint != dataset.fingerprint():
            raise SarsplatError(
                f"{run.path} was started with another dataset ({run.dataset_path}); resume it with that one"
            )
        refuse_other_settings(run.folder, run.config, config)
        files = RunFolder(run.folder)
        begun = files.checkpoint_path is not None
        if begun and run.iteration > config.iterations:
            raise SarsplatError(
                f"{run.path} has already done {run.iteration} iterations, more than {config.iterations}; resume it "
                f"with at least {run.iteration}"
            )
        other_results = any(name not in AnyConfig.may_change for name, _, _ in run.config.changes(config))
        where = None if dataset.path is None else dataset.path.resolve()
        self.run = resumed = replace(run, dataset_path=where, config=config)
        if begun:
            snapshot = run.snapshot
            try:
                self.trainer.restore(snapshot)
            except (LookupError, TypeError, ValueError, RuntimeError, OverflowError) as error:
                raise SarsplatError(
                    f"{files.checkpoint_path} does not match this version ({error}); start again with overwrite=True"
                ) from error
            self._begun -= snapshot.seconds
            self.history = [line for line in run.history if line.iteration <= snapshot.iteration]
            self.shown.start_at(snapshot.iteration)
        if resumed != run:
            resumed.write_header()
        if other_results or self.trainer.iteration < config.iterations:
            if files.state.has_results:
                self.shown.note(f"points, scores and report of the first {files.state.done:,} iterations are removed")
            files.remove_results()
        write_bytes(files.log_path, log_text(self.history))

    def advance_to(self, iterations: int) -> None:
        """Step until `iterations` are done; save a checkpoint however the loop ends between two steps."""
        trainer, begun = self.trainer, self.trainer.iteration
        try:
            with ThreadChoice(str(getattr(trainer, "device", "cpu"))) as threads:
                self._steps(iterations, threads)
        finally:
            unsaved = trainer.iteration > begun and trainer.iteration % trainer.config.checkpoint_every
            if self._between_steps and unsaved:
                self._save()

    def _steps(self, iterations: int, threads: "ThreadChoice") -> None:
        trainer, config = self.trainer, self.trainer.config
        every = max(1, config.iterations // _LOG_LINES)
        losses: list[Tensor] = []
        while trainer.iteration < iterations and not self.ended:
            self._between_steps = False
            try:
                loss = threads.step(trainer.step)
                losses.append(loss)
                logs = trainer.iteration % every == 0 or trainer.iteration == config.iterations
                saves = self.run is not None and trainer.iteration % config.checkpoint_every == 0
                if logs or saves:
                    trainer.check()  # before saving
            except SarsplatError:
                self._require_finite(losses)  # report its cause, a loss that is not finite, first
                raise
            line = self._line(losses) if logs else None
            self._between_steps = True
            if line is not None:
                losses = []
                self._log(line)
            elif time.monotonic() - self._shown_at > _UPDATE_S:
                self._show(loss.item())
            if saves:
                self._save()
            step = Step(trainer.iteration, loss, trainer, line, self.folder_to_come, self.last)
            self.ended = self._on_step is not None and self._on_step(step) is True

    def _line(self, losses: list[Tensor]) -> LogLine:
        loss = sum(self._require_finite(losses)) / len(losses)
        return LogLine(self.trainer.iteration, round(self.seconds, 3), loss, self.trainer.gaussian_count)

    def _require_finite(self, losses: list[Tensor]) -> list[float]:
        """Return losses as numbers; raise if one is not finite."""
        values: list[float] = torch.stack(losses).tolist() if losses else []  # one wait for the device
        for iteration, value in enumerate(values, self.trainer.iteration - len(values) + 1):
            if not math.isfinite(value):
                raise SarsplatError(
                    f"the loss became {value} at iteration {iteration}; lower the learning rates, or make a custom "
                    "loss finite for all images (the last checkpoint is from before)"
                )
        return values

    def _log(self, line: LogLine) -> None:
        self.history.append(line)
        self._show(line.loss)
        if self.run is not None:
            path = RunFolder(self.run.folder).log_path
            with plain_os_errors("write", path), path.open("ab") as file:
                file.write(log_text([line]))

    def _show(self, loss: float) -> None:
        count = self.trainer.gaussian_count
        self.shown.update(
            self.trainer.iteration, f"loss {loss:.3g}" + ("" if count is None else f"  {count} Gaussians")
        )
        self._shown_at = time.monotonic()

    def _save(self) -> None:
        if self.run is None:
            return
        RunFolder(self.run.folder).save(self.trainer.snapshot(self.seconds))


class ThreadChoice:
    """Choice of the quickest of 1, 2, 4, … threads for steps, repeated every 100 steps.

    The context restores torch's number of threads. Inactive on GPUs and outside of the main thread.
    """

    def __init__(self, device: str) -> None:
        self._most = torch.get_num_threads()
        self._active = device == "cpu" and self._most > 1 and threading.current_thread() is threading.main_thread()
        self._until_trial = 0
        self._untried: list[int] = []
        self._seconds: dict[int, float] = {}

    def __enter__(self) -> "ThreadChoice":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._active:
            torch.set_num_threads(self._most)

    def step(self, make: Callable[[], M]) -> M:
        """Run one step and return its result."""
        if not self._active:
            return make()
        if self._until_trial == 0:
            counts = [*(2**k for k in range(self._most.bit_length()) if 2**k < self._most), self._most]
            self._until_trial, self._seconds = _TRIAL_EVERY, {}
            self._untried = [n for n in counts for _ in range(_TRIAL_STEPS)]
        self._until_trial -= 1
        if not self._untried:
            return make()
        count = self._untried.pop(0)
        torch.set_num_threads(count)
        begun = time.perf_counter()
        result = make()
        elapsed = time.perf_counter() - begun
        self._seconds[count] = min(elapsed, self._seconds.get(count, elapsed))
        if count not in self._untried and self._seconds[count] > _MAX_SLOWDOWN * min(self._seconds.values()):
            self._untried = []
        if not self._untried:
            torch.set_num_threads(min(self._seconds, key=lambda threads: self._seconds[threads]))
        return result


def train(
    training: Training[Any], new: Run, dataset: Dataset, out: Path | None, *, resume: bool, overwrite: bool
) -> Run:
    """Train to the end and return the run, in memory or in the folder `out`; raise as `reconstruct`.

    `training` is at its beginning; `new` is the run with settings and fingerprint, without storage. An exception leaves
    a checkpoint; points, which may take longer than the training, are extracted only at the end.
    """
    config = training.trainer.config
    if (resume and overwrite) or (out is None and (resume or overwrite)):
        raise SarsplatError("a run in a folder is either resumed or overwritten; give out, and only one of these")
    if out is None:
        training.advance_to(config.iterations)
        held = InMemory(training.trainer.snapshot(training.seconds), training.history)
        return replace(new, memory=held, images=dataset)
    if resume:
        training.run = Run.load(out)
    else:
        if overwrite:
            require_replaceable(out)
        refuse_existing(out, overwrite, marker=HEADER)
    stopped: BaseException | None = None
    with only_writer(out):
        if resume:
            training.resume(dataset)
        else:
            with new_folder(out, overwrite, marker=HEADER) as folder:
                training.run, training.folder_to_come = replace(new, path=folder), out
                training.run.write_header()
                try:
                    training.advance_to(min(config.checkpoint_every, config.iterations))
                except BaseException as error:
                    if RunFolder(folder).checkpoint_path is None:
                        raise
                    if (out / HEADER).is_file():
                        if not isinstance(error, KeyboardInterrupt):
                            raise
                        raise KeyboardInterrupt(
                            f"stopped before the first checkpoint; {out} is still as it was"
                        ) from error
                    stopped = error
            training.run, training.folder_to_come = Run.load(out), None
        if stopped is not None:
            raise stopped
        training.advance_to(config.iterations)
        if RunFolder(out).state.finished and (out / ABOUT).is_file():  # nothing was left to do
            return replace(Run.load(out), images=dataset)
        training.shown.note("extracting the surface: points and normals; Ctrl-C leaves that for later")
        finished = replace(Run.load(out), images=dataset)
        finished.write_results()
    return finished
