"""A scene of Gaussians to look at: its images with and without its parts, and who makes their pixels."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.radar import Pixel
from sarsplat.reconstruction.model import SceneModel
from sarsplat.viewer.subject import Cloud, Contributors, Subject

_FAINT = 0.05
"""Optical depth below which a Gaussian is not drawn."""


class SceneImages:
    """Pictures of a learned scene with and without its ground and the shadow on it.

    Parameters
    ----------
    model : SceneModel
        The scene; copied, so that a training may go on with it.
    degree : int
        Of its harmonics.
    grid : ImageGrid
        Pixels of the images; rays stand half a spacing apart.
    """

    def __init__(self, model: SceneModel, degree: int, grid: ImageGrid) -> None:
        self._model, self._groundless = model.copy(), model.copy(ground=False)
        self._degree, self._grid = degree, grid
        self.scene, self.target = (part.detach() for part in (self._model.scene(degree), self._model.target(degree)))
        self.has_ground = len(self.scene) > len(self.target)
        self.displaced_grid = model.as_displaced(grid)

    @cached_property
    def cloud(self) -> Cloud:
        """The centres of the Gaussians that are not faint."""
        places = self.target.means[self.target.optical_depth > _FAINT]
        return Cloud("Gaussians", places.cpu().numpy(), self._grid.cell_m / 3)

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """γ⁰ towards the radar, linear, of the Gaussian nearest to each place."""
        if cloud.name not in self._nearest:
            self._nearest[cloud.name] = cKDTree(self.target.means.double().cpu().numpy()).query(cloud.places_m)[1]
        towards = self.target.means.new_tensor(view.direction)[None]
        gamma0: Float[np.ndarray, " n"] = self.target.gamma0(towards)[0].cpu().numpy()[self._nearest[cloud.name]]
        return gamma0

    @cached_property
    def _nearest(self) -> dict[str, np.ndarray]:
        return {}

    def render(self, view: View, *, ground: bool, shadow: bool) -> Float32[np.ndarray, "rows columns"]:
        """β⁰, linear power; without `shadow`, target and ground are each seen as if the other were not there."""
        if not self.has_ground or (ground and shadow):
            return self._image(self._model, view)
        target = self._image(self._groundless, view)
        if not ground:
            return target
        # the noise floor is in both pictures
        return target + self._image(self._model, view, empty=True) - self._image(self._groundless, view, empty=True)

    @torch.no_grad()
    def _image(self, model: SceneModel, view: View, *, empty: bool = False) -> Float32[np.ndarray, "rows columns"]:
        rays = RayGrid.for_image(self._grid)
        left_out = torch.ones(len(self.target), dtype=torch.bool, device=model.device) if empty else None
        images, _ = model.render([view], self._grid, self._degree, rays=rays, left_out=left_out)
        image: Float32[np.ndarray, "rows columns"] = images[0, model.power_channel].cpu().numpy()
        return image


class OfScene(Subject):
    """A subject that is a scene of Gaussians."""

    renders = True
    scatters = True
    images: SceneImages

    def look_at(self, images: SceneImages) -> None:
        """Say which scene."""
        self.images, self.has_ground = images, images.has_ground

    @property
    def maps_grid(self) -> ImageGrid:
        """See `Subject`."""
        return self.images.displaced_grid

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """See `Subject`: of the nearest Gaussian."""
        return self.images.gamma0(cloud, view)

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        """See `Subject`."""
        return self.images.render(view, ground=ground, shadow=shadow)

    def contributors(self, view: View, pixel: Pixel) -> Contributors | None:
        """See `Subject`: by power."""
        return self._shares(self.images.scene, len(self.images.target), view, pixel)
