"""The training loop of all methods: step, log, save now and then, and resume where an earlier one stopped."""

from __future__ import annotations

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
from sarsplat.runs.run import InMemory, Run
from sarsplat.runs.run_folder import ABOUT, HEADER, LogLine, RunFolder, log_text, require_replaceable
from sarsplat.settings.config import AnyConfig, refuse_other_settings

_LINES_PER_RUN = 200
"""About how many lines `metrics.jsonl` gets."""

_SECONDS_UNSEEN = 5.0
"""The progress is shown at least this often, if steps are not longer."""

_TRIAL_EVERY = 100
"""Steps between trials: the load of the machine and the size of the images change."""

_TRIAL_STEPS = 2
"""Steps of a trial with each number of threads, of which the quicker one counts."""

_HOPELESS = 1.5
"""Time of a step, relative to the quickest, after which more threads are not tried."""

M = TypeVar("M")
T = TypeVar("T", bound=Trainable)


@dataclass(frozen=True)
class Step(Generic[T]):
    """What is passed to a watcher of a training after each step."""

    iteration: int
    """Steps done, this one included."""
    loss: Tensor
    """Its loss, a single number; reading it waits for the device."""
    trainer: T
    """The training itself, between two steps; that of `sar-gs` has the target as it is now, `trainer.gaussians`."""
    line: LogLine | None = None
    """The line that the log gets after this step; None after most."""
    folder_to_come: Path | None = None
    """The run's folder as long as it is being built elsewhere, which is until after the first checkpoint: nothing may
    be written there yet. Then, and for a run in memory, None."""
    last: bool = False
    """Whether this process makes no more steps: there are none, or others make them."""


class Training(Generic[T]):
    """A trainer at work: counts the time, calls `on_step`, and keeps the log.

    `run` is the one whose folder gets the log and the checkpoints; None in memory. `ended` is whether `on_step` asked
    for the end.
    """

    def __init__(
        self,
        trainer: T,
        on_step: Callable[[Step[T]], object] | None,
        shown: Reporter,
    ) -> None:
        self.trainer, self.shown, self._on_step = trainer, shown, on_step
        self.history: list[LogLine] = []
        self.run: Run | None = None
        self.ended = False
        self.folder_to_come: Path | None = None
        self._between_steps = True
        self._begun = self._shown_at = time.monotonic()

    @property
    def seconds(self) -> float:
        """Time trained so far, s of wall clock."""
        return time.monotonic() - self._begun

    @property
    def last(self) -> bool:
        """Whether the step that was just made is the last one of this process."""
        return self.trainer.iteration >= self.trainer.config.iterations

    def resume(self, dataset: Dataset) -> None:
        """Bring the trainer, the log and the folder to the newest checkpoint of `run`."""
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
            self.history = [line for line in run.history if line.iteration <= snapshot.iteration]  # a killed one's end
            self.shown.start_at(snapshot.iteration)
        if resumed != run:
            resumed.write_header()
        if other_results or self.trainer.iteration < config.iterations:
            if files.state.has_results:
                self.shown.note(f"points, scores and report of the first {files.state.done:,} iterations are removed")
            files.remove_results()
        write_bytes(files.log_path, log_text(self.history))

    def advance_to(self, iterations: int) -> None:
        """Step until so many iterations are done; what has been learned is saved whatever ends it between two steps."""
        trainer, begun = self.trainer, self.trainer.iteration
        try:
            with ThreadChoice(str(getattr(trainer, "device", "cpu"))) as threads:
                self._steps(iterations, threads)
        finally:
            unsaved = trainer.iteration > begun and trainer.iteration % trainer.config.checkpoint_every
            if self._between_steps and unsaved:
                self._save()

    def _steps(self, iterations: int, threads: ThreadChoice) -> None:
        trainer, config = self.trainer, self.trainer.config
        every = max(1, config.iterations // _LINES_PER_RUN)
        losses: list[Tensor] = []
        while trainer.iteration < iterations and not self.ended:
            self._between_steps = False
            try:
                loss = threads.step(trainer.step)
                losses.append(loss)
                logs = trainer.iteration % every == 0 or trainer.iteration == config.iterations
                saves = self.run is not None and trainer.iteration % config.checkpoint_every == 0
                if logs or saves:
                    trainer.check()  # as a part of the step: what is wrong is not saved
            except SarsplatError:
                self._require_finite(losses)  # or what came of a loss that is not would be named instead of it
                raise
            line = self._line(losses) if logs else None
            self._between_steps = True
            if line is not None:
                losses = []
                self._log(line)
            elif time.monotonic() - self._shown_at > _SECONDS_UNSEEN:
                self._show(loss.item())
            if saves:
                self._save()
            step = Step(trainer.iteration, loss, trainer, line, self.folder_to_come, self.last)
            self.ended = self._on_step is not None and self._on_step(step) is True

    def _line(self, losses: list[Tensor]) -> LogLine:
        loss = sum(self._require_finite(losses)) / len(losses)
        return LogLine(self.trainer.iteration, round(self.seconds, 3), loss, self.trainer.gaussian_count)

    def _require_finite(self, losses: list[Tensor]) -> list[float]:
        """The losses of the last iterations; refused if one is not finite."""
        values: list[float] = torch.stack(losses).tolist() if losses else []  # one wait for the device
        for ago, value in enumerate(reversed(values)):
            if not math.isfinite(value) and all(map(math.isfinite, values[: len(values) - ago - 1])):
                raise SarsplatError(
                    f"the loss became {value} at iteration {self.trainer.iteration - ago}; lower the learning rates, "
                    "or see that a loss of your own is finite for all images (the last checkpoint is from before)"
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
    """Runs steps with the quickest of 1, 2, 4, … threads, found anew every 100 steps.

    The context restores torch's number of threads at its end. Inactive on GPUs and outside of the main thread.
    """

    def __init__(self, device: str) -> None:
        self._most = torch.get_num_threads()
        self._active = device == "cpu" and self._most > 1 and threading.current_thread() is threading.main_thread()
        self._until_trial = 0
        self._untried: list[int] = []
        self._seconds: dict[int, float] = {}

    def __enter__(self) -> ThreadChoice:
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
        made = make()
        took = time.perf_counter() - begun
        self._seconds[count] = min(took, self._seconds.get(count, took))
        if count not in self._untried and self._seconds[count] > _HOPELESS * min(self._seconds.values()):
            self._untried = []
        if not self._untried:
            torch.set_num_threads(min(self._seconds, key=lambda threads: self._seconds[threads]))
        return made


def train(
    training: Training[Any], new: Run, dataset: Dataset, out: Path | None, *, resume: bool, overwrite: bool
) -> Run:
    """Train to the end, in memory or, with `out`, in a folder from which it can be resumed at any time.

    `training` is at its beginning; `new` is the run as it will be, with settings and the dataset's fingerprint. An
    exception leaves a checkpoint, from which a run shows what it has learned; only a finished one gets its points,
    which may take longer than the training. Refusals are those of `reconstruct`.
    """
    config = training.trainer.config
    if resume and overwrite:
        raise SarsplatError("a run is either resumed or overwritten; give only one of resume and overwrite")
    if out is None and (resume or overwrite):
        raise SarsplatError("a run in memory can be neither resumed nor overwritten; pass a folder as `out`")
    if out is None:
        training.advance_to(config.iterations)
        held = InMemory(training.trainer.snapshot(training.seconds), tuple(training.history))
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
        if RunFolder(out).state.finished and (out / ABOUT).is_file():  # there was nothing to go on with
            return replace(Run.load(out), images=dataset)
        training.shown.note("extracting the surface: points and normals; Ctrl-C leaves that for later")
        finished = replace(Run.load(out), images=dataset)
        finished.write_results()
    return finished
