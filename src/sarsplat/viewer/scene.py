"""A scene of Gaussians: its images with and without ground and shadow, and which Gaussians make their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.model import SceneModel
from sarsplat.radar import Pixel
from sarsplat.runs.own_gaussians import own_scene
from sarsplat.viewer.subject import Cloud, Contributors, Subject

_FAINT = 0.05
"""Optical depth below which a Gaussian is not drawn."""


class OfScene(Subject):
    """A subject that is a scene of Gaussians, shown with and without its ground and the shadow on it."""

    renders = True
    scatters = True

    def look_at(self, model: SceneModel, degree: int) -> None:
        """Set the scene and the degree of its harmonics; copied, so that a training may continue with it."""
        self._model, self._groundless, self._degree = model.copy(), model.copy(ground=False), degree
        self.scene, self.target = (part.detach() for part in (self._model.scene(degree), self._model.target(degree)))
        self.has_ground = model.ground() is not None
        self._nearest: dict[str, np.ndarray] = {}

    @property
    def maps_grid(self) -> ImageGrid:
        return self._model.as_displaced(self.grid)

    @cached_property
    def gaussian_cloud(self) -> Cloud:
        """The centres of the Gaussians that are not faint."""
        places = self.target.means[self.target.optical_depth > _FAINT]
        return Cloud("Gaussians", places.cpu().numpy(), self.grid.cell_m / 3)

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """See `Subject`: of the Gaussian nearest to each place."""
        if cloud.name not in self._nearest:
            self._nearest[cloud.name] = cKDTree(self.target.means.double().cpu().numpy()).query(cloud.places_m)[1]
        towards = self.target.means.new_tensor(view.look.way_out)[None]
        gamma0: Float[np.ndarray, " n"] = self.target.gamma0(towards)[0].cpu().numpy()[self._nearest[cloud.name]]
        return gamma0

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        if not self.has_ground or (ground and shadow):
            return self._image(self._model, view)
        target = self._image(self._groundless, view)
        if not ground:
            return target
        # the noise floor is in both pictures
        return target + self._image(self._model, view, empty=True) - self._image(self._groundless, view, empty=True)

    @torch.no_grad()
    def _image(self, model: SceneModel, view: View, *, empty: bool = False) -> Float32[np.ndarray, "rows columns"]:
        rays = RayGrid.for_image(self.grid)
        dropped = torch.ones(len(self.target), dtype=torch.bool, device=model.device) if empty else None
        images, _ = model.render([view], self.grid, self._degree, rays=rays, dropped=dropped)
        image: Float32[np.ndarray, "rows columns"] = images[0, model.power_channel].cpu().numpy()
        return image

    def contributors(self, view: View, pixel: Pixel) -> Contributors | None:
        """See `Subject`: by power."""
        return self._shares(self.scene, len(self.target), view, pixel)


class SceneAlone(OfScene):
    """Gaussians that no run holds."""

    surface = None  # its normals would take seconds

    @cached_property
    def clouds(self) -> list[Cloud]:
        return [self.gaussian_cloud]


def scene_of(
    gaussians: Gaussians, grid: ImageGrid | None = None, views: Sequence[View] | None = None, peak: float | None = None
) -> SceneAlone:
    """Gaussians of one's own; grid, views and the power shown white are chosen unless given."""
    config, snapshot = own_scene(gaussians, grid, views, peak, 0.0)
    peak = peak or snapshot.brightest
    scene = SceneAlone(f"{len(gaussians):,} Gaussians", snapshot.grid, snapshot.views, peak, None)
    scene.look_at(SceneModel.saved(snapshot, config), config.harmonics_degree)
    return scene
