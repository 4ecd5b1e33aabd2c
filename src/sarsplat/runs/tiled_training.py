"""Training by tiles: first the scene from coarse images, then each tile from fine ones, here or by an executor.

A model of coarse images fits into memory, and refinements are local. Each tile continues from the coarse model together
with the surroundings in its images; these are dropped before the tiles are merged.
"""

import ctypes
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import torch

from sarsplat.data import Dataset, read_dataset
from sarsplat.data.files import locked, plain_os_errors
from sarsplat.errors import SarsplatError
from sarsplat.executors.executor import Work
from sarsplat.learning import Inputs, Trainer
from sarsplat.learning.device_choice import device_named
from sarsplat.learning.losses import Loss
from sarsplat.learning.observations.single_images import PartsOfImages, Tile, merged, tiles_of, with_some
from sarsplat.learning.snapshot import Snapshot
from sarsplat.progress import PartOfSteps, Reporter, progress
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import HEADER, LogLine, RunFolder
from sarsplat.runs.training_loop import Step, Training

_FOLDER = "tiles"  # folder of the tiles' runs inside a run, until all are finished
_EVERY_S = 2.0  # interval between readings of other processes' progress, s


class TileJob(msgspec.Struct, frozen=True):
    """Training of a tile in another process."""

    work: ClassVar[str] = "sarsplat.runs.tiled_training:TILE"

    number: int
    """Index of the tile."""
    dataset: str
    """Folder of the dataset."""
    iterations: int
    """Iterations of the whole training."""
    device: str

    @property
    def address(self) -> str:
        return str(self.number)


class TileEnd(msgspec.Struct):
    """Result of a `TileJob`."""

    reason: str = ""
    """Sentence on the failure; "" if finished."""


TileExecutor = Callable[[Sequence[TileJob], Path], Iterator[tuple[TileJob, TileEnd | None]]]
"""Executor of tiles with its resources: (jobs, folder of all tiles) → ends of the jobs."""


class TiledTraining(Training[Trainer]):
    """Training that continues by N × N tiles once images are too fine for the whole scene.

    Tiles begin at the first level with blocks of fewer than N × N pixels: before, the whole has no more blocks than a
    tile has pixels. The `Step`s of each tile count iterations from there; an `executor` makes no `Step`s.
    """

    def __init__(
        self,
        trainer: Trainer,
        on_step: Callable[[Step[Any]], object] | None,
        shown: Reporter,
        dataset: Dataset,
        inputs: Inputs,
        executor: TileExecutor | None = None,
    ) -> None:
        super().__init__(trainer, on_step, shown)
        self._dataset, self._inputs, self._watcher, self._executor = dataset, inputs, on_step, executor
        self._begin = begin_of_tiles(trainer)

    @property
    def last(self) -> bool:
        return super().last or (self._executor is not None and self.trainer.iteration >= self._begin)

    def advance_to(self, iterations: int) -> None:
        """Train the whole scene to the first level of tiles and then, once the run has its final folder, by tiles."""
        whole = self.trainer
        if whole.iteration < self._begin:
            self._remove_tiles()  # of an earlier, shorter training
            super().advance_to(min(iterations, self._begin))
            if self.folder_to_come is not None:
                return
        if whole.iteration < iterations and not self.ended:
            self._by_tiles(iterations)
        if whole.iteration >= iterations:
            self._remove_tiles()

    def _by_tiles(self, iterations: int) -> None:
        """Train and merge all tiles; without a result if `on_step` ends the training."""
        whole, rows = self.trainer, self.trainer.model.rows
        begun = whole.snapshot(self.seconds)
        tiles, parts, lines = tiles_of(whole.model.parameters["means"], whole.config.tiles), [], []
        if self._executor is not None:
            self._by_executor(self._executor, len(tiles), begun.iteration, iterations)
        for number, tile in enumerate(tiles):
            if self._executor is not None:
                learned = Run.load(self._folder_of(number))
                part, history = learned.snapshot, learned.history
            else:
                part, history = self._trained(tile, f"tile {number + 1} of {len(tiles)}", number, begun, iterations)
            if self.ended:
                return
            parts.append(with_some(part, rows, tile.holds(part.tensors["model/means"])))
            lines.append(history[-1])
        seconds = begun.seconds + sum(part.seconds for part in parts)
        self._begun = time.monotonic() - seconds
        whole.restore(merged(parts, rows, seconds))
        loss = sum(line.loss for line in lines) / len(lines)
        self._log(LogLine(iterations, round(seconds, 3), loss, len(whole.model)))
        self._save()

    def _trained(
        self, tile: Tile, name: str, number: int, begun: Snapshot, iterations: int
    ) -> tuple[Snapshot, list[LogLine]]:
        """Train a tile to the end, resuming it if begun; return its state and log."""
        whole, shown = self.trainer, PartOfSteps(self.shown, number * (iterations - begun.iteration), name)
        setup = whole.config, whole.device, self._inputs.loss
        folder = None if self.run is None else self.run.folder / _FOLDER
        training = train_tile(
            tile, number, self.run, self._dataset, setup, begun, iterations, self._watcher, shown, folder
        )
        self.ended = training.ended
        return training.trainer.snapshot(training.seconds), training.history

    def _by_executor(self, executor: TileExecutor, count: int, begun: int, iterations: int) -> None:
        """Have all tiles trained by an executor, each in its folder."""
        folder = self._folder_of(0).parent.resolve()  # workers have another working directory
        with plain_os_errors("write", folder):
            folder.mkdir(parents=True, exist_ok=True)
        assert self._dataset.path is not None
        device, where = self.trainer.device.type, str(self._dataset.path.resolve())
        finished = [RunFolder(self._folder_of(k)).checkpoint_path for k in range(count)]
        unfinished = [k for k, path in enumerate(finished) if path is None or int(path.stem) < iterations]
        jobs = [TileJob(k, where, iterations, device) for k in unfinished]
        with self._watched(count, begun), closing(executor(jobs, folder)) as ended:  # type: ignore[type-var]
            for job, end in ended:
                if end is None or end.reason:
                    reason = end.reason if end else "another process is training it; stop that first"
                    raise SarsplatError(f"tile {job.number + 1} of {count} was not finished: {reason}")

    @contextmanager
    def _watched(self, count: int, begun: int) -> Iterator[None]:
        """Show the progress of other processes from their logs while the block runs."""
        stop, logs = threading.Event(), [RunFolder(self._folder_of(k)) for k in range(count)]

        def steps() -> int:
            done = begun
            for log in logs:
                with suppress(OSError, SarsplatError):  # it may be just being replaced
                    done += log.history[-1].iteration - begun if log.history else 0
            return done

        def watch() -> None:
            while not stop.wait(_EVERY_S):
                self.shown.update(steps(), f"{count} tiles, by other processes")

        thread = threading.Thread(target=watch, daemon=True)
        self.shown.start_at(steps())
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def _folder_of(self, number: int) -> Path:
        assert self.run is not None  # an executor needs a folder
        return self.run.folder / _FOLDER / str(number)

    def _remove_tiles(self) -> None:
        if self.run is not None:
            shutil.rmtree(self.run.folder / _FOLDER, ignore_errors=True)


def steps_of(trainer: Trainer) -> int:
    iterations, begin = trainer.config.iterations, begin_of_tiles(trainer)
    return begin + trainer.config.tiles**2 * (iterations - begin)


def begin_of_tiles(trainer: Trainer) -> int:
    """Return the first iteration of tiles; raise if the coarsest images are too fine for the whole scene."""
    tiles, coarsest = trainer.config.tiles, trainer.model.levels.coarsest
    if tiles > coarsest:
        limit = "the setting coarsest" if coarsest == trainer.config.coarsest else "the scene's size"
        raise SarsplatError(
            f"tiles is {tiles}, but images of the whole scene have blocks of {coarsest} × {coarsest} pixels, by "
            f"{limit}; give tiles from 1 to {coarsest}"
        )
    return trainer.model.levels.begin_below(tiles)


def train_tile(
    tile: Tile,
    number: int,
    whole: Run | None,
    dataset: Dataset,
    setup: tuple[Any, torch.device, Loss | None],
    begun: Snapshot,
    iterations: int,
    on_step: Callable[[Step[Any]], object] | None,
    shown: Reporter,
    folder: Path | None,
) -> Training[Trainer]:
    """Train a tile from the state `begun` of the whole scene to `iterations`.

    `setup` holds settings, device and custom loss. With the `folder` of all tiles and the scene's run `whole`, the
    tile has a folder `number` in it, from which it is resumed.
    """
    _release_memory()
    config, device, loss = setup
    parts = PartsOfImages(dataset, config, device, begun, tile)
    trainer = Trainer(dataset, config, loss, device, observation=parts)
    trainer.restore(parts.begun)
    training = Training(trainer, on_step, shown)
    if folder is not None and whole is not None:
        _open(training, whole, dataset, folder / str(number))
    training.advance_to(iterations)
    return training


def _open(training: Training[Trainer], whole: Run, dataset: Dataset, folder: Path) -> None:
    if (folder / HEADER).is_file():
        training.run = Run.load(folder)
        training.resume(dataset)
        return
    training.run = replace(whole, path=folder)
    with plain_os_errors("write", folder):
        folder.mkdir(parents=True, exist_ok=True)
    training.run.write_header()


def _release_memory() -> None:
    """Return free memory to the system: glibc keeps fragments too small for a tile."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def _do(job: TileJob, out: Path, again: bool) -> TileEnd | None:
    """Train the tile of a job."""
    torch.set_num_threads(1)
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(out / job.address))
        except SarsplatError:
            return None
        try:
            run, dataset = Run.load(out.parent), read_dataset(Path(job.dataset))
            shown = stack.enter_context(progress("tile", 1, quiet=True))
            if dataset.fingerprint() != run.fingerprint:
                raise SarsplatError(f"{job.dataset} has changed since the training was begun; restore it")
            begun = run.snapshot
            tile = tiles_of(begun.tensors["model/means"], run.config.tiles)[job.number]
            setup = run.config, device_named(job.device), None
            train_tile(tile, job.number, run, dataset, setup, begun, job.iterations, None, shown, out)
        except SarsplatError as error:
            return TileEnd(str(error))
        except Exception as error:  # a bug or no memory: other tiles continue
            traceback.print_exc()
            return TileEnd(f"{type(error).__name__}: {error}")
    return TileEnd()


TILE = Work(TileJob, TileEnd, _do, lambda job, out, reason: TileEnd(reason), "resume the run to go on with it")
"""Training of a tile, as work of an executor."""
