"""Training by tiles: the whole scene first, on coarse images, and then tile after tile on finer ones.

What coarse images teach about all of a scene is little, and fits into memory; what they leave to finer ones is local.
Each tile goes on from there by itself, with its surroundings as far as its images show them; these are dropped at its
end, so that no more than the Gaussians of the tiles themselves are put together.
"""

from __future__ import annotations

import ctypes
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from sarsplat.data import Dataset
from sarsplat.data.files import plain_os_errors
from sarsplat.errors import SarsplatError
from sarsplat.learning.method import Inputs
from sarsplat.learning.observations.parts_of_images import PartsOfImages, Tile, merged, rows_in, tiles_of
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.trainer import Trainer
from sarsplat.progress import Reporter
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import HEADER, LogLine
from sarsplat.runs.training_loop import Step, Training

_FOLDER = "tiles"
"""In a run's folder, until its tiles are finished: a run of each."""


class TiledTraining(Training[Trainer]):
    """A training that goes on by tiles where images get too fine for the whole scene.

    The tiles, N × N, begin with the first level whose blocks of pixels are smaller than N × N: before, the whole has no
    more of them than a tile has pixels. A tile's `Step`s count iterations from there again.
    """

    def __init__(
        self,
        trainer: Trainer,
        on_step: Callable[[Step[Any]], object] | None,
        shown: Reporter,
        dataset: Dataset,
        inputs: Inputs,
    ) -> None:
        super().__init__(trainer, on_step, shown)
        self._dataset, self._inputs, self._watcher = dataset, inputs, on_step
        self._begin = begin_of_tiles(trainer)

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
        whole = self.trainer
        begun = whole.snapshot(self.seconds)
        tiles, parts, lines = tiles_of(whole.model.parameters["means"], whole.config.tiles), [], []
        for number, tile in enumerate(tiles):
            part, history = self._trained(tile, f"tile {number + 1} of {len(tiles)}", number, begun, iterations)
            if self.ended:
                return
            parts.append(part)
            lines.append(history[-1])
        seconds = begun.seconds + sum(part.seconds for part in parts)
        self._begun = time.monotonic() - seconds
        whole.restore(merged(parts, rows_in(whole.model), seconds))
        loss = sum(line.loss for line in lines) / len(lines)
        self._log(LogLine(iterations, round(seconds, 3), loss, len(whole.model)))
        self._save()

    def _trained(
        self, tile: Tile, name: str, number: int, begun: Snapshot, iterations: int
    ) -> tuple[Snapshot, list[LogLine]]:
        """What a tile learns, and its log; from where it had come."""
        _give_back_memory()
        whole, shown = self.trainer, self.shown.within(number * (iterations - begun.iteration), name)
        parts = PartsOfImages(self._dataset, whole.config, whole.device, begun, tile)
        trainer = Trainer(self._dataset, whole.config, self._inputs.loss, whole.device, observation=parts)
        trainer.restore(parts.begun)
        training = Training(trainer, self._watcher, shown)
        if self.run is not None:
            self._open(training, self.run, str(number))
        training.advance_to(iterations)
        self.ended = training.ended
        return parts.of_tile(trainer.snapshot(training.seconds), trainer.model), training.history

    def _open(self, training: Training[Trainer], run: Run, name: str) -> None:
        """Give a tile its folder, in which it goes on if it was begun."""
        folder = run.folder / _FOLDER / name
        if (folder / HEADER).is_file():
            training.run = Run.load(folder)
            training.resume(self._dataset)
            return
        training.run = replace(run, path=folder)
        with plain_os_errors("write", folder):
            folder.mkdir(parents=True, exist_ok=True)
        training.run.write_header()

    def _remove_tiles(self) -> None:
        if self.run is not None:
            shutil.rmtree(self.run.folder / _FOLDER, ignore_errors=True)


def _give_back_memory() -> None:
    """Return to the system what is free: glibc keeps it in pieces, into which what a tile needs does not fit."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


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
