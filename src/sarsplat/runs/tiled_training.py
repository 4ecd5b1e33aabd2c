"""Training by tiles: the whole scene first, on coarse images, and then tile after tile on finer ones.

What coarse images teach about all of a scene is little, and fits into memory; what they leave to finer ones is local.
Each tile goes on from there by itself, with its surroundings as far as its images show them; these are dropped at its
end, so that no more than the Gaussians of the tiles themselves are put together.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from sarsplat.data import Dataset
from sarsplat.data.files import plain_os_errors
from sarsplat.errors import SarsplatError
from sarsplat.learning.method import Inputs
from sarsplat.learning.observations.parts_of_images import Tile, merged, rows_in, tiles_of, with_some
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.trainer import Trainer
from sarsplat.progress import Reporter
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import LogLine, RunFolder
from sarsplat.runs.tile_work import TileEnd, TileJob, train_tile
from sarsplat.runs.training_loop import Step, Training

_FOLDER = "tiles"
"""In a run's folder, until its tiles are finished: a run of each."""

_EVERY_S = 2.0
"""Between two looks at how far other processes are."""

Others = Callable[[Sequence[TileJob], Path], Iterator[tuple[TileJob, TileEnd | None]]]
"""Has tiles learned by other processes, in the folder of all of them: an `Executor`, and what it may use."""


class TiledTraining(Training[Trainer]):
    """A training that goes on by tiles where images get too fine for the whole scene.

    The tiles, N × N, begin with the first level whose blocks of pixels are smaller than N × N: before, the whole has no
    more of them than a tile has pixels. A tile's `Step`s count iterations from there again; `others` learn them
    elsewhere, without `on_step`.
    """

    def __init__(
        self,
        trainer: Trainer,
        on_step: Callable[[Step[Any]], object] | None,
        shown: Reporter,
        dataset: Dataset,
        inputs: Inputs,
        others: Others | None = None,
    ) -> None:
        super().__init__(trainer, on_step, shown)
        self._dataset, self._inputs, self._watcher, self._others = dataset, inputs, on_step, others
        self._begin = begin_of_tiles(trainer)

    @property
    def last(self) -> bool:
        return super().last or (self._others is not None and self.trainer.iteration >= self._begin)

    def advance_to(self, iterations: int) -> None:
        """Train the whole as far as it goes, and then, in a folder that is there to stay, by tiles."""
        whole = self.trainer
        if whole.iteration < self._begin:
            self._remove_tiles()  # of a training that was shorter
            super().advance_to(min(iterations, self._begin))
            if self.folder_to_come is not None:
                return
        if whole.iteration < iterations and not self.ended:
            self._by_tiles(iterations)
        if whole.iteration >= iterations:
            self._remove_tiles()

    def _by_tiles(self, iterations: int) -> None:
        """Bring the trainer from where it is to the end; to nowhere if `on_step` asks for the end before."""
        whole, rows = self.trainer, rows_in(self.trainer.model)
        begun = whole.snapshot(self.seconds)
        tiles, parts, lines = tiles_of(whole.model.parameters["means"], whole.config.tiles), [], []
        if self._others is not None:
            self._by_others(self._others, len(tiles), begun.iteration, iterations)
        for number, tile in enumerate(tiles):
            if self._others is not None:
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
        """What is learned for a tile, and its log; from where it had come."""
        whole, shown = self.trainer, self.shown.within(number * (iterations - begun.iteration), name)
        how = whole.config, whole.device, self._inputs.loss
        folder = None if self.run is None else self.run.folder / _FOLDER
        training = train_tile(
            tile, number, self.run, self._dataset, how, begun, iterations, self._watcher, shown, folder
        )
        self.ended = training.ended
        return training.trainer.snapshot(training.seconds), training.history

    def _by_others(self, others: Others, count: int, begun: int, iterations: int) -> None:
        """Have all tiles finished by other processes, each in its folder."""
        folder = self._folder_of(0).parent.resolve()  # others work in another folder
        with plain_os_errors("write", folder):
            folder.mkdir(parents=True, exist_ok=True)
        assert self._dataset.path is not None
        device, where = self.trainer.device.type, str(self._dataset.path.resolve())
        finished = [RunFolder(self._folder_of(k)).checkpoint_path for k in range(count)]
        left = [k for k, path in enumerate(finished) if path is None or int(path.stem) < iterations]
        jobs = [TileJob(k, where, iterations, device) for k in left]
        with self._watched(count, begun), closing(others(jobs, folder)) as ended:  # type: ignore[type-var]
            for job, end in ended:
                if end is None or end.reason:
                    reason = end.reason if end else "another process is learning it; end that first"
                    raise SarsplatError(f"tile {job.number + 1} of {count} was not finished: {reason}")

    @contextmanager
    def _watched(self, count: int, begun: int) -> Iterator[None]:
        """Show how far other processes are, by what they write, while the block runs."""
        over, logs = threading.Event(), [RunFolder(self._folder_of(k)) for k in range(count)]

        def steps() -> int:
            done = begun
            for log in logs:
                with suppress(OSError, SarsplatError):  # it may be replaced just now
                    done += log.history[-1].iteration - begun if log.history else 0
            return done

        def watch() -> None:
            while not over.wait(_EVERY_S):
                self.shown.update(steps(), f"{count} tiles, by other processes")

        watching = threading.Thread(target=watch, daemon=True)
        self.shown.start_at(steps())
        watching.start()
        try:
            yield
        finally:
            over.set()
            watching.join()

    def _folder_of(self, number: int) -> Path:
        assert self.run is not None  # those that others learn are in folders
        return self.run.folder / _FOLDER / str(number)

    def _remove_tiles(self) -> None:
        if self.run is not None:
            shutil.rmtree(self.run.folder / _FOLDER, ignore_errors=True)


def steps_of(trainer: Trainer) -> int:
    iterations, begin = trainer.config.iterations, begin_of_tiles(trainer)
    return begin + trainer.config.tiles**2 * (iterations - begin)


def begin_of_tiles(trainer: Trainer) -> int:
    """The first iteration that is one of tiles; refused if the coarsest images are too fine for the whole."""
    tiles, coarsest = trainer.config.tiles, trainer.model.levels.coarsest
    if tiles > coarsest:
        limit = "the setting coarsest" if coarsest == trainer.config.coarsest else "the scene's size"
        raise SarsplatError(
            f"tiles is {tiles}, but the whole scene is first learned from images of blocks of {coarsest} × {coarsest} "
            f"pixels, by {limit}, and these must not be smaller than tiles × tiles; give tiles from 1 to {coarsest}"
        )
    return trainer.model.levels.begin_below(tiles)
