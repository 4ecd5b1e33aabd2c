"""Training images on the device, and the random order in which steps use them."""

from collections.abc import Sequence
from copy import copy

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.data.image import in_blocks
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.snapshot import Snapshot
from sarsplat.renderer.engines.on_device import ChosenViews

_FAINTEST = 1e-30  # largest β⁰ of images that count as black: squares and reciprocals would leave float32


class TrainingImages:
    """Training images of a dataset on a device; raises if they are black.

    `views`, as refined so far, and `grid`; `truth`, float32 [K, rows, columns], β⁰ in linear power, and `brightest`,
    the largest; `numbers`, int64 [K], 0, 1, … on the device; `samples`, independent samples of speckle in each image.
    """

    def __init__(self, dataset: Dataset, device: torch.device) -> None:
        train, power = dataset.select("train"), torch.from_numpy(dataset.images("train"))
        self.views, self.grid, self.brightest = train.views, dataset.grid, float(power.max())
        if not self.brightest > _FAINTEST:
            raise SarsplatError(
                f"the training images of {dataset} are black everywhere (largest β⁰ {self.brightest:.3g}); "
                "simulate or import again"
            )
        self.samples = self.grid.independent_samples * (train.looks or 1.0)
        self.truth = power.to(device)
        self.numbers = torch.arange(len(self.views), device=device)

    def views_of(self, chosen: Sequence[int] | Int64[Tensor, " v"]) -> Sequence[View]:
        """Views of the chosen images."""
        return ChosenViews(self.views, chosen) if isinstance(chosen, Tensor) else [self.views[i] for i in chosen]

    def of(
        self, chosen: Sequence[int] | Int64[Tensor, " v"]
    ) -> tuple[Int64[Tensor, " v"], Float32[Tensor, "v rows columns"]]:
        """Numbers and β⁰ of the chosen images."""
        if isinstance(chosen, Tensor):
            return chosen, self.truth.index_select(0, chosen)
        # stacked: much faster than an index
        return torch.stack([self.numbers[i] for i in chosen]), torch.stack([self.truth[i] for i in chosen])

    def through(self, windows: Windows) -> "TrainingImages":
        """Windows of these images, stacked."""
        cut = copy(self)
        cut.truth, cut.grid = windows.of(self.truth), windows.stack
        return cut

    def multilooked(self, factor: int, views: tuple[View, ...]) -> "TrainingImages":
        """Means of power over blocks of factor × factor pixels, with these views."""
        looked = copy(self)
        looked.views = views
        if factor > 1:
            looked.grid = self.grid.multilooked(factor)
            looked.truth = in_blocks(self.truth, factor).mean(4).mean(2)
            looked.samples = self.samples * looked.grid.independent_samples / self.grid.independent_samples
        return looked


class ViewQueue:
    """Batches of `per_step` view indices, shuffled anew for each epoch.

    `generator` is on the CPU, so that the order is the same on every device.
    """

    def __init__(self, views: int, per_step: int, generator: torch.Generator) -> None:
        self.waiting: list[int] = []
        self.size = min(per_step, views)
        """Number of views of a batch."""
        self._views, self._generator = views, generator

    def next(self) -> list[int]:
        while len(self.waiting) < self.size:
            self.waiting += torch.randperm(self._views, generator=self._generator, device="cpu").tolist()
        chosen, self.waiting = self.waiting[: self.size], self.waiting[self.size :]
        return chosen

    def restore(self, snapshot: Snapshot) -> None:
        """Restore the queue and the generator from a snapshot.

        Raises ValueError, KeyError, TypeError or RuntimeError if the snapshot does not hold them.
        """
        if len(snapshot.views) != self._views or not all(0 <= k < self._views for k in snapshot.queue):
            raise ValueError(f"its views or its queue are not those of {self._views} training images")
        self._generator.set_state(snapshot.tensors["generator"])
        self.waiting = list(snapshot.queue)
