"""TensorBoard logs of trainings: curves, and images of a few fixed views."""

import math
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.data.files import plain_os_errors
from sarsplat.extras import needed
from sarsplat.radiometry import LEAST_POWER, shade, white_level
from sarsplat.runs.run_folder import HEADER, LogLine
from sarsplat.runs.training_loop import Step

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_GROWTH = math.sqrt(2)  # images are rendered at the iterations 1, 2, 3, 4, 6, 8, 11, 16 …


class TensorBoard:
    """Callback (`on_step`) of a training that writes a log for TensorBoard.

    The training's result is the same bits with and without it. A log that exists is continued; after a resume, entries
    beyond its checkpoint are hidden.

    Parameters
    ----------
    folder : str or Path
        Folder of the log. Inside the folder of a new run, the log is written at the first checkpoint, complete.
    dataset : Dataset
        Source of the fixed views and their true images.
    training_views, test_views : int
        Maximum numbers of fixed views, evenly chosen.

    Raises
    ------
    SarsplatError
        If tensorboard is not installed; while training, if the folder cannot be written.

    Notes
    -----
    Scalars with each line of the training's log: `loss`, the mean since the previous line; `terms/…`, its other terms;
    `learning rate/…`; `Gaussians`; `seconds per step`. Images: the truth at step 0, and renderings at growing
    intervals.
    """

    @checks_arguments
    def __init__(self, folder: str | Path, dataset: Dataset, *, training_views: int = 2, test_views: int = 2) -> None:
        _writer_class()  # raises if it is missing
        self._folder = Path(folder)
        tested = [index for index, entry in enumerate(dataset.entries) if entry.split != "train"]
        trained = [index for index, entry in enumerate(dataset.entries) if entry.split == "train"]
        shown = [*_evenly(trained, training_views), *_evenly(tested, test_views)]
        self._entries = [dataset.entries[index] for index in shown]
        self._truth = dataset.power[shown]
        self._brightest = white_level(self._truth)
        self._waiting: list[Callable[[SummaryWriter], object]] = []
        self._writer: SummaryWriter | None = None
        self._began_at: int | None = None
        self._last: tuple[int, float] | None = None  # iteration and seconds of the last line
        self._awaited: Path | None = None  # folder of a new run, which must appear before the log is written

    def __call__(self, step: Step[Any]) -> None:
        """Log a step."""
        if self._began_at is None:
            self._begin(step)
        if step.line is not None:
            self._scalars(step, step.line)
        last = step.iteration == step.trainer.config.iterations
        if last or _shows(step.iteration):
            images = step.trainer.rendered([entry.view for entry in self._entries])
            self._images("rendered", images, step.iteration)
        if self._must_wait(step):
            return
        self._awaited = None
        if self._waiting:
            self._write()
        if last:
            self.close()

    def close(self) -> None:
        """Write pending entries, unless the run's folder never appeared, and close the file."""
        if self._waiting and self._awaited is not None and self._awaited.is_dir():
            self._write()
        self._waiting, self._began_at = [], None
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _must_wait(self, step: Step[Any]) -> bool:
        run = step.folder_to_come
        return run is not None and self._folder.absolute().is_relative_to(run.absolute())

    def _begin(self, step: Step[Any]) -> None:
        self._began_at = step.iteration
        if self._must_wait(step) and step.folder_to_come is not None and not (step.folder_to_come / HEADER).exists():
            self._awaited = step.folder_to_come
        if step.iteration == 1:
            self._last = (0, 0.0)
            self._images("truth", self._truth, 0)

    def _scalars(self, step: Step[Any], line: LogLine) -> None:
        values = {"loss": line.loss, **{f"terms/{name}": float(value) for name, value in step.trainer.terms.items()}}
        values |= {f"learning rate/{name}": rate for name, rate in step.trainer.learning_rates.items()}
        if line.gaussians is not None:
            values["Gaussians"] = line.gaussians
        if self._last is not None:
            values["seconds per step"] = (line.seconds - self._last[1]) / (line.iteration - self._last[0])
        self._last = (line.iteration, line.seconds)
        for name, value in values.items():
            self._waiting.append(methodcaller("add_scalar", name, value, line.iteration))

    def _images(self, kind: str, power: Float32[np.ndarray, "v rows columns"], iteration: int) -> None:
        """Log images with white at the `white_level` of the truth, row 0 (near range) at the top."""
        grey = np.round(255 * shade(power, max(self._brightest, LEAST_POWER))).astype(np.uint8)
        for entry, image in zip(self._entries, grey, strict=True):
            name = entry.name.replace("/", " ")  # slashes make groups
            angles = f"azimuth {entry.view.azimuth_deg:g}°, grazing {entry.view.grazing_deg:g}°{entry.view.unusual}"
            tag = f"{entry.split} {name}, {angles}/{kind}"
            self._waiting.append(methodcaller("add_image", tag, image, iteration, dataformats="HW"))

    def _write(self) -> None:
        with plain_os_errors("write", self._folder):
            if self._writer is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                begun = any(self._folder.glob("events.out.tfevents.*"))
                self._writer = _writer_class()(str(self._folder), purge_step=self._began_at if begun else None)
            for add in self._waiting:
                add(self._writer)
            self._writer.flush()  # readable even if killed
        self._waiting = []


def _writer_class() -> "type[SummaryWriter]":
    with needed("tensorboard", "a log for TensorBoard"):
        from torch.utils.tensorboard import SummaryWriter
    return SummaryWriter


def _evenly(indices: list[int], count: int) -> list[int]:
    """Choose at most `count` indices evenly, the first included."""
    count = min(count, len(indices))
    return [indices[k * len(indices) // count] for k in range(count)]


def _shows(iteration: int) -> bool:
    power = round(math.log(iteration, _GROWTH)) if iteration > 1 else 0
    return iteration in {round(_GROWTH**k) for k in (power - 1, power, power + 1)}
