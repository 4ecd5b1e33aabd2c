"""Observations of the power of single images: whole, or, after training the whole scene, the parts that show a tile."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Polarimetric
from sarsplat.geometry import RayGrid
from sarsplat.learning.batching import compared_in_groups, in_groups
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.losses import LOSSES, Loss, named_loss
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.observation import Batch, Observation
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import Rendering, channel_of
from sarsplat.settings.config import Config


class SingleImages(Observation):
    """β⁰ of each training image, compared by the configuration's loss or a custom one."""

    order = 2
    recordable = True

    def __init__(self, dataset: Dataset, config: Config, device: torch.device) -> None:
        super().__init__(dataset, config, device)
        self.images = TrainingImages(dataset, device)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return True

    @classmethod
    def refuse(cls, config: Config, dataset: Dataset, inputs: Inputs) -> None:
        if config.scattering == Polarimetric.kind and not (config.passes and dataset.polarimetric):
            lacks = "passes is off" if dataset.polarimetric else f"{dataset} has one"
            raise SarsplatError(
                f"scattering is {config.scattering}, which needs passes on and several polarisations, but {lacks}; "
                f"choose harmonics{', or passes on' if dataset.polarimetric else ''}"
            )
        if config.bounce is not None and dataset.terrain is not None:
            raise SarsplatError(f"bounce is on, which needs level ground, but {dataset} has terrain; give bounce off")
        super().refuse(config, dataset, inputs)

    def minimise(self, loss: Loss | None, model: SceneModel) -> Tensor:
        self._mean_over_views = loss is None  # true of all named losses
        self._loss = loss or named_loss(self.config, self.images.brightest, model.unit)
        if loss is None and LOSSES[self.config.loss].unit.startswith("nats"):  # penalties are in nats, too
            return torch.ones((), dtype=torch.float32, device=self.device)
        return _of_black(self._loss, self.images.truth[: self.config.views_per_step])

    def compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        chosen = batch.chosen
        if isinstance(chosen, Tensor) or not self._mean_over_views:
            return self._compared(model, images, batch)
        groups = in_groups(len(chosen), len(chosen), model.parameters, images.grid, batch.rays, model.scenes_rendered)
        return compared_in_groups(
            lambda group: self._compared(model, images, replace(batch, chosen=chosen[group])),
            groups,
            [*model.parameters.values()],
        )

    def _compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        numbers, truth = images.of(batch.chosen)
        rendered, rendering = model.render(
            images.views_of(batch.chosen),
            images.grid,
            batch.degree,
            rays=batch.rays,
            numbers=numbers,
            plane_gradients=batch.plane_gradients,
            bounds=batch.bounds,
            dropped=batch.dropped,
        )
        return self._loss(channel_of(rendered, model.power_channel), truth), rendering


@torch.no_grad()
def _of_black(loss: Loss, truth: Float32[Tensor, "v rows columns"]) -> Tensor:
    """Loss of black images, the unit of penalties; 1 if it is not finite and positive."""
    value = loss(torch.zeros_like(truth), truth.clone())  # a copy: custom losses may change it
    if not isinstance(value, Tensor) or value.is_complex():  # the first step raises
        return truth.new_ones(())
    return torch.where(value.isfinite() & (value > 0), value, 1.0)


@dataclass(frozen=True)
class Tile:
    """A rectangle on the ground; unbounded at the edges of the scene."""

    low: tuple[float, float]
    high: tuple[float, float]
    """Corners (x, y), m; the upper ones belong to the next tile."""

    def holds(self, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Mask of the centres in the tile."""
        places = means.detach()[:, :2]
        return ((places >= places.new_tensor(self.low)) & (places < places.new_tensor(self.high))).all(1)


class PartsOfImages(SingleImages):
    """Parts of single images that show the Gaussians in a tile; `whole` is the training of the whole scene before.

    It trains these Gaussians, and those around the tile that its images show or that occlude these. Parameters that are
    not per Gaussian, such as the ground's, are frozen.
    """

    order = 3
    switch = "tiles 1"
    goes_with: ClassVar = {"bounce": None, "surroundings": None, "densification": None}
    takes_strategies = False
    recordable = False  # images have windows of their own

    def __init__(self, dataset: Dataset, config: Config, device: torch.device, whole: Snapshot, tile: Tile) -> None:
        super().__init__(dataset, config, device)
        model = SceneModel.saved(whole, config, device)
        scene, levels = model.target(model.degree(whole.iteration)).detach(), model.levels
        learned_m = whole.grid.multilooked(levels.factor(max(whole.iteration - 1, 0))).cell_m  # its accuracy
        own, finest = tile.holds(scene.means), levels.factor(whole.iteration)
        self.tile = tile
        self._windows = Windows.around(scene[own], whole.views, whole.grid, learned_m, finest)
        rays = RayGrid.for_image(whole.grid.multilooked(finest), config.rays_per_pixel)
        near = own | self._windows.shown(scene, whole.views, rays, model.ground(), learned_m)
        self.begun = with_some(whole, model.rows, near)
        """Snapshot from which the tile's training begins."""
        self.images = self.images.through(self._windows)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.tiles > 1

    def first_model(self, generator: torch.Generator) -> SceneModel:
        return SceneModel.saved(self.begun, self.config, self.device)

    def begin(self, model: SceneModel) -> None:
        model.look_through(self._windows)


def tiles_of(means: Float[Tensor, "n 3"], side: int) -> list[Tile]:
    """Divide centres into `side` × `side` tiles of nearly equal numbers."""
    every = Tile((-math.inf, -math.inf), (math.inf, math.inf))
    return [tile for slab in _cut(every, means, side, 0) for tile in _cut(slab, means, side, 1)]


def _cut(tile: Tile, means: Float[Tensor, "n 3"], parts: int, axis: int) -> list[Tile]:
    """Divide a tile along an axis; into fewer parts if too few centres differ."""
    places = means.detach().cpu()[tile.holds(means).cpu()][:, axis].sort().values
    inner = [float(places[len(places) * k // parts]) for k in range(1, parts)]
    edges = [tile.low[axis], *sorted({edge for edge in inner if edge > float(places[0])}), tile.high[axis]]
    if axis == 0:
        return [Tile((low, tile.low[1]), (high, tile.high[1])) for low, high in pairwise(edges)]
    return [Tile((tile.low[0], low), (tile.high[0], high)) for low, high in pairwise(edges)]


def with_some(snapshot: Snapshot, rows: Collection[str], which: Bool[Tensor, " n"]) -> Snapshot:
    """Snapshot with a subset of the Gaussians; `rows` names the parameters with a row for each."""
    chosen = which.cpu().nonzero()[:, 0]
    subset = {name: tensor[chosen] for name, tensor in snapshot.tensors.items() if _of_rows(name, rows)}
    return replace(snapshot, tensors=snapshot.tensors | subset)


def merged(parts: Sequence[Snapshot], rows: Collection[str], seconds: float) -> Snapshot:
    """Join the Gaussians of snapshots; all else is that of the first one."""
    first = parts[0]
    joined = {name: torch.cat([part.tensors[name] for part in parts]) for name in first.tensors if _of_rows(name, rows)}
    return replace(first, seconds=seconds, tensors=first.tensors | joined)


def _of_rows(name: str, rows: Collection[str]) -> bool:
    """Return True if a tensor of a snapshot has a row for each Gaussian."""
    kind, _, which = name.partition("/")
    return (kind in ("model", "optimiser") and which.partition("/")[0] in rows) or "/rows/" in which
