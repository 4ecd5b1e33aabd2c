"""A tile of a scene as a training of its own: in this process, or as work of an executor in another one."""

from __future__ import annotations

import ctypes
import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import torch

from sarsplat.data import Dataset, read_dataset
from sarsplat.data.files import locked, plain_os_errors
from sarsplat.errors import SarsplatError
from sarsplat.executors.executor import Work
from sarsplat.learning.device_choice import device_named
from sarsplat.learning.losses import Loss
from sarsplat.learning.observations.parts_of_images import PartsOfImages, Tile, tiles_of
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.trainer import Trainer
from sarsplat.progress import Reporter, progress
from sarsplat.runs.run import Run
from sarsplat.runs.run_folder import HEADER
from sarsplat.runs.training_loop import Step, Training


class TileJob(msgspec.Struct, frozen=True):
    """A tile that another process learns; the folder of all of them lies in the run's."""

    work: ClassVar[str] = "sarsplat.runs.tile_work:TILE"

    number: int
    """Of the tile, from 0."""
    dataset: str
    """Its folder."""
    iterations: int
    """Of the whole training."""
    device: str

    @property
    def address(self) -> str:
        return str(self.number)


class TileEnd(msgspec.Struct):
    """How it ended."""

    reason: str = ""
    """Why it is not finished: a sentence."""


def train_tile(
    tile: Tile,
    number: int,
    whole: Run | None,
    dataset: Dataset,
    trainer: tuple[Any, torch.device, Loss | None],
    begun: Snapshot,
    iterations: int,
    on_step: Callable[[Step[Any]], object] | None,
    shown: Reporter,
    folder: Path | None,
) -> Training[Trainer]:
    """A tile's training, so many iterations of the whole one long, from where that was when tiles began.

    `trainer` are the settings, the device and a loss of one's own. With the `folder` of all tiles, the one of this
    number has its own in that, in which it goes on if it was begun; `whole` is the scene's run.
    """
    _give_back_memory()
    config, device, loss = trainer
    parts = PartsOfImages(dataset, config, device, begun, tile)
    made = Trainer(dataset, config, loss, device, observation=parts)
    made.restore(parts.begun)
    training = Training(made, on_step, shown)
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


def _give_back_memory() -> None:
    """Return to the system what is free: glibc keeps it in pieces, into which what a tile needs does not fit."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def _do(job: TileJob, out: Path, again: bool) -> TileEnd | None:
    """Learn a tile in the folder of all of them."""
    torch.set_num_threads(1)
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(out / job.address))
        except SarsplatError:
            return None
        try:
            run, dataset, shown = Run.load(out.parent), read_dataset(Path(job.dataset)), stack.enter_context(_silent())
            if dataset.fingerprint() != run.fingerprint:
                raise SarsplatError(f"{job.dataset} has changed since the training was begun; restore it")
            begun = run.snapshot
            tile = tiles_of(begun.tensors["model/means"], run.config.tiles)[job.number]
            how = run.config, device_named(job.device), None
            train_tile(tile, job.number, run, dataset, how, begun, job.iterations, None, shown, out)
        except SarsplatError as error:
            return TileEnd(str(error))
        except Exception as error:  # a fault of ours or of a plugin, or no memory: the others go on
            traceback.print_exc()
            return TileEnd(f"{type(error).__name__}: {error}")
    return TileEnd()


def _silent() -> Any:
    return progress("tile", 1, quiet=True)


TILE = Work(TileJob, TileEnd, _do, lambda job, out, reason: TileEnd(reason), "resume the run to go on with it")
"""A tile, as work of an executor."""
