"""Training of one tile: what the whole scene has taught at coarser levels goes on, on parts of the images."""

from __future__ import annotations

import torch

from sarsplat.data import Dataset
from sarsplat.geometry import RayGrid
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.losses import Loss
from sarsplat.learning.model import SceneModel
from sarsplat.learning.scene_tiles import Tile, with_some
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.trainer import Trainer
from sarsplat.learning.training_images import TrainingImages
from sarsplat.settings.config import Config


class TileTrainer(Trainer):
    """A training of the Gaussians in a tile, and of those around it that its images show, or that shade these.

    What is not of single Gaussians, as the ground, stays as the whole scene has taught it.

    Parameters
    ----------
    dataset, config, loss, device
        As of `Trainer`.
    whole : Snapshot
        The training of the whole scene, where it ends and tiles begin.
    tile : Tile
        Which.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        loss: Loss | None,
        device: torch.device,
        whole: Snapshot,
        tile: Tile,
    ) -> None:
        model = SceneModel.saved(whole, config, device)
        scene, levels = model.target(model.degree(whole.iteration)).detach(), model.levels
        learned_m = levels.grid_at(levels.factor(max(whole.iteration - 1, 0))).cell_m  # the whole is right to a cell
        own, finest = tile.holds(scene.means), levels.factor(whole.iteration)
        self.tile = tile
        self._windows = Windows.around(scene[own], whole.views, whole.grid, learned_m, finest)
        rays = RayGrid.for_image(levels.grid_at(finest), config.rays_per_pixel)
        near = own | self._windows.shown(scene, whole.views, rays, model.ground(), learned_m)
        self._begun = with_some(whole, rows_in(model), near)
        super().__init__(dataset, config, loss, device)
        self.restore(self._begun)

    def _images_of(self, dataset: Dataset) -> TrainingImages:
        return super()._images_of(dataset).through(self._windows)

    def _first_model(self, dataset: Dataset) -> SceneModel:
        return SceneModel.saved(self._begun, self.config, self.device)

    def _learn(self, model: SceneModel) -> None:
        model.look_through(self._windows)
        super()._learn(model)

    def result(self, seconds: float) -> Snapshot:
        """The training without what is around the tile."""
        means = self.model.parameters["means"]
        return with_some(self.snapshot(seconds), rows_in(self.model), self.tile.holds(means))


def rows_in(model: SceneModel) -> list[str]:
    """Names of the parameters with a row for each Gaussian."""
    return [name for name, how in model.learned.items() if how.per_gaussian]
