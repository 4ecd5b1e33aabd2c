"""Learning a tile of a scene from the parts of the images that show it: the whole scene has been learned before."""

from __future__ import annotations

from typing import ClassVar

import torch

from sarsplat.data import Dataset
from sarsplat.geometry import RayGrid
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.single_images import SingleImages
from sarsplat.learning.scene_tiles import Tile, with_some
from sarsplat.learning.snapshot import Snapshot
from sarsplat.settings.config import Config


class PartsOfImages(SingleImages):
    """The parts of single images that show the Gaussians in a tile; `whole` is the scene's training where tiles begin.

    Learned are these Gaussians, and those around the tile that its images show, or that shade these. What is not of
    single Gaussians, as the ground, stays as the whole scene has taught it.
    """

    order = 3
    switch = "tiles 1"
    goes_with: ClassVar = {"surroundings": None, "densification": None}
    takes = frozenset()

    def __init__(self, dataset: Dataset, config: Config, device: torch.device, whole: Snapshot, tile: Tile) -> None:
        super().__init__(dataset, config, device)
        model = SceneModel.saved(whole, config, device)
        scene, levels = model.target(model.degree(whole.iteration)).detach(), model.levels
        learned_m = levels.grid_at(levels.factor(max(whole.iteration - 1, 0))).cell_m  # the whole is right to a cell
        own, finest = tile.holds(scene.means), levels.factor(whole.iteration)
        self.tile = tile
        self._windows = Windows.around(scene[own], whole.views, whole.grid, learned_m, finest)
        rays = RayGrid.for_image(levels.grid_at(finest), config.rays_per_pixel)
        near = own | self._windows.shown(scene, whole.views, rays, model.ground(), learned_m)
        self.begun = with_some(whole, rows_in(model), near)
        """Where the tile's training begins."""
        self.images = self.images.through(self._windows)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.tiles > 1

    def first_model(self, generator: torch.Generator) -> SceneModel:
        return SceneModel.saved(self.begun, self.config, self.device)

    def begin(self, model: SceneModel) -> None:
        model.look_through(self._windows)

    def of_tile(self, snapshot: Snapshot, model: SceneModel) -> Snapshot:
        """A state of the tile's training without what is around the tile."""
        return with_some(snapshot, rows_in(model), self.tile.holds(model.parameters["means"]))


def rows_in(model: SceneModel) -> list[str]:
    """Names of the parameters with a row for each Gaussian."""
    return [name for name, how in model.learned.items() if how.per_gaussian]
