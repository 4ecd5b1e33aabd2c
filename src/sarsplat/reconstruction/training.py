"""From a dataset to a run: train, log, save on the way, and go on where an earlier training stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sarsplat.data import Dataset, new_folder, read_dataset, write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import only_writer, refuse_existing
from sarsplat.data.plausible import suspicions, warn
from sarsplat.errors import SarsplatError
from sarsplat.progress import Reporter, progress
from sarsplat.reconstruction.config import Config, refuse_other_settings
from sarsplat.reconstruction.lengths import lengths
from sarsplat.reconstruction.log import LogLine, log_text
from sarsplat.reconstruction.losses import LOSSES, Loss
from sarsplat.reconstruction.presets import preset
from sarsplat.reconstruction.run import HEADER, InMemory, Run, require_replaceable
from sarsplat.reconstruction.snapshot import Snapshot
from sarsplat.reconstruction.trainer import Trainer
from sarsplat.renderer.cuda_device import require_cuda

_LINES_PER_RUN = 200
"""About how many lines `metrics.jsonl` gets."""

_CHECKPOINTS_KEPT = 2


@dataclass(frozen=True)
class Step:
    """What a watcher of a training is told after each step.

    Parameters
    ----------
    iteration : int
        Steps done, this one included.
    loss : Tensor
        Its loss, a single number; reading it waits for the device.
    trainer : Trainer
        The training itself, between two steps: `trainer.gaussians` is the target as it is now.
    """

    iteration: int
    loss: Tensor
    trainer: Trainer


Watcher = Callable[[Step], object]


def reconstruct(
    dataset: Dataset | str | Path,
    preset: str | Config = "auto",
    out: str | Path | None = None,
    *,
    device: str = "auto",
    loss: Loss | None = None,
    on_step: Watcher | None = None,
    quiet: bool = False,
    resume: bool = False,
    overwrite: bool = False,
) -> Run:
    """Reconstruct a target from the training images of a dataset.

    Parameters
    ----------
    dataset : Dataset, str or Path
        The images, or the folder that holds them.
    preset : str or Config
        How: a name in `PRESETS`, a configuration of your own, or "auto": "measured" where the images show ground,
        "speckled" where there is only speckle, "default" elsewhere. To resume, "auto" is what the run was begun with.
    out : str or Path, optional
        Folder of the run; it appears, or replaces an earlier run, with the first checkpoint. Without it everything
        stays in memory.
    device : {"auto", "cpu", "cuda"}
        Where to train; "auto" is a GPU if there is one that can be used.
    loss : callable, optional
        Instead of the configuration's: `loss(rendered, truth)` is given two float32 stacks [V, rows, columns] of
        β⁰, linear power, and returns one number that torch can differentiate. It is first asked for the loss of black
        images, the unit of `scattering_penalty`. The run's configuration has its name; to resume, give it again.
    on_step : callable, optional
        Called after every step (`Step`). If it returns True, the training ends there, and the run is what has been
        learned so far. An exception ends it too; what has been learned is then kept in `out`.
    quiet : bool
        Show no progress.
    resume : bool
        Go on from the newest checkpoint in `out`, exactly as if the training had never stopped. The settings must be
        those the run was started with, except `iterations`, `checkpoint_every` and `points`: more iterations extend
        a run, even a finished one, and its points are extracted anew.
    overwrite : bool
        Replace an existing run.

    Returns
    -------
    Run
        The finished run. If KeyboardInterrupt or another exception ends the training, what was saved stays usable; but
        an earlier run stays if the new one has no checkpoint yet.

    Raises
    ------
    SarsplatError
        If `out` exists (to resume: does not), another process is writing it, or dataset or configuration are not those
        the run was started with.
    """
    dataset = dataset if isinstance(dataset, Dataset) else read_dataset(Path(dataset))
    begun = Run.load(out).config if resume and preset == "auto" and out is not None else None
    config = begun or fitting(preset, dataset)
    if loss is not None:
        name = getattr(loss, "__name__", type(loss).__name__)
        config = replace(config, loss=f"own {name}" if name in LOSSES else name)
    warn(suspicions(dataset))
    trainer = Trainer(dataset, config, loss, training_device(device))
    with progress(f"reconstruct ({config.preset})", config.iterations, quiet) as shown:
        training = _Training(trainer, on_step, shown)
        shown.note(lengths(config, dataset.grid))
        if out is None:
            if resume or overwrite:
                raise SarsplatError("a run in memory can be neither resumed nor overwritten; pass a folder as `out`")
            fingerprint = dataset.fingerprint()  # before the work, in case it has none
            training.go_on_to(config.iterations)
            held = InMemory(dataset, trainer.snapshot(training.seconds), tuple(training.history))
            return Run(config, fingerprint, memory=held)
        return _on_the_disk(training, dataset, Path(out), resume, overwrite)


def fitting(choice: str | Config, dataset: Dataset) -> Config:
    """The configuration that is meant: where there is ground or speckle, it must be modelled."""
    if isinstance(choice, Config):
        return choice
    if choice != "auto":
        return preset(choice)
    return preset("measured" if dataset.ground else "default" if dataset.looks is None else "speckled")


def training_device(name: str) -> torch.device:
    """The device of that name; "auto" is "cuda" where it can be used.

    Raises
    ------
    SarsplatError
        If there is no such device, or it cannot be used.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise SarsplatError(f"device {name!r} is unknown; choose auto, cpu or cuda")
    if name != "cpu":
        try:
            require_cuda()
        except SarsplatError:
            if name == "cuda":
                raise
            name = "cpu"
    return torch.device("cpu" if name == "cpu" else "cuda:0")


class _Training:
    """A trainer at work: counts the time, tells whoever watches, and keeps the log."""

    def __init__(self, trainer: Trainer, on_step: Watcher | None, shown: Reporter) -> None:
        self.trainer, self.shown, self._on_step = trainer, shown, on_step
        self.history: list[LogLine] = []
        self.between_steps = True
        self.ended = False  # by whoever watches
        self._begun = time.monotonic()

    @property
    def seconds(self) -> float:
        """Time trained so far, s of wall clock."""
        return time.monotonic() - self._begun

    def start_from(self, snapshot: Snapshot, history: list[LogLine]) -> None:
        """Take up a state, and the log that led there."""
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
                self.shown.update(line.iteration, f"loss {line.loss:.3g}  {line.gaussians} Gaussians")
                if log is not None:
                    log(line)
            if save is not None and saves:
                save()
            if self._on_step is not None and self._on_step(Step(trainer.iteration, loss, trainer)) is True:
                self.ended = True
                return

    def _line(self, losses: list[Tensor]) -> LogLine:
        loss = sum(torch.stack(losses).tolist()) / len(losses)  # one wait for the device
        if not math.isfinite(loss):
            raise SarsplatError(
                f"the loss became {loss} at iteration {self.trainer.iteration}; lower the learning rates (the last "
                "checkpoint is from before)"
            )
        return LogLine(self.trainer.iteration, round(self.seconds, 3), loss, len(self.trainer.model))


def _on_the_disk(training: _Training, dataset: Dataset, out: Path, resume: bool, overwrite: bool) -> Run:
    """Train with a folder from which the training can be taken up at any time."""
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
            _take_up(training, begun, dataset)
        else:
            with new_folder(out, overwrite, marker=HEADER) as folder:
                run = Run.create(folder, dataset, config)
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
        try:
            if stopped is None and not training.ended:
                _train(training, Run.load(out), config.iterations)
        finally:  # the run is usable as far as it has come
            finished = Run.load(out)
            if finished.checkpoint_path is not None:
                training.shown.note("extracting the surface: points and normals")
                finished.write_results()
    if stopped is not None:
        raise stopped
    return finished


def _take_up(training: _Training, run: Run, dataset: Dataset) -> None:
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
    other_points = run.config.points != config.points
    run = run.taken_up(dataset, config)
    if run.checkpoint_path is not None:
        snapshot = run.snapshot
        try:
            training.start_from(snapshot, run.history)
        except (LookupError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise SarsplatError(
                f"{run.checkpoint_path} does not match this version ({error}); start again with --overwrite"
            ) from error
    if other_points or training.trainer.iteration < config.iterations:
        run.remove_results()
    write_bytes(run.log_path, log_text(training.history))


def _train(training: _Training, run: Run, iterations: int) -> None:
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
