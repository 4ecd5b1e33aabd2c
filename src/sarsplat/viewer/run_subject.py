"""Runs to look at: of Gaussians, and of methods that learn something else."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from sarsplat.errors import SarsplatError
from sarsplat.evaluation.points import surface_distance
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.radar import Pixel, Surface, surface_of_run
from sarsplat.reconstruction import AnyRun, Run
from sarsplat.reconstruction.model import SceneModel
from sarsplat.viewer.subject import Cloud, Contributors, Subject, at_most

_FAINT = 0.05
"""Optical depth below which a Gaussian is not drawn."""


def subject_of_run(run: AnyRun[Any]) -> Subject:
    """A run of any method; its dataset may be gone."""
    return GaussianSubject(run) if isinstance(run, Run) else RunSubject(run)


class RunSubject(Subject):
    """A run of any method.

    Parameters
    ----------
    run : AnyRun
        The run.
    """

    renders = True

    def __init__(self, run: AnyRun[Any]) -> None:
        self.run = run
        try:
            dataset = run.dataset
        except SarsplatError:  # rendering needs no images
            dataset = None
        name = "a run" if run.path is None else run.path.name
        super().__init__(f"{name}: {run.learned}", run.grid, run.snapshot.views, run.brightest, dataset)

    @cached_property
    def clouds(self) -> list[Cloud]:
        """See `Subject`."""
        points = Cloud("surface points", at_most(self.run.points), self.grid.cell_m / 5)
        return [points, *super().clouds] if self.truth is None else [points, self._truth_cloud]

    @property
    def _truth_cloud(self) -> Cloud:
        import trimesh

        assert self.truth is not None
        samples, _ = trimesh.sample.sample_surface(self.truth, 30_000, seed=0)
        return Cloud("true surface", np.asarray(samples, np.float32), self.grid.cell_m / 5)

    @cached_property
    def surface(self) -> Surface | None:
        """See `Subject`."""
        try:
            return surface_of_run(self.run)
        except SarsplatError:  # it has learned no surface
            return None

    def error_m(self, cloud: Cloud) -> Float[np.ndarray, " n"] | None:
        """See `Subject`."""
        if self.truth is None:
            return None
        if cloud.name not in self._errors:
            triangles = np.asarray(self.truth.triangles, np.float64)
            self._errors[cloud.name] = surface_distance(cloud.places_m.astype(np.float64), triangles)
        return self._errors[cloud.name]

    @cached_property
    def _errors(self) -> dict[str, Float[np.ndarray, " n"]]:
        return {}

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        """See `Subject`."""
        return self.run.render([view])[0]


class GaussianSubject(RunSubject):
    """A run of Gaussians."""

    scatters = True

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._images = SceneImages(run.model, run.model.degree(run.iteration), run.grid)
        self.has_ground = self._images.has_ground

    @property
    def maps_grid(self) -> ImageGrid:
        """See `Subject`."""
        return self._images.displaced_grid

    @cached_property
    def clouds(self) -> list[Cloud]:
        """See `Subject`."""
        points, *others = super().clouds
        return [points, gaussian_cloud(self._images.target, self.grid), *others]

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """See `Subject`: of the nearest Gaussian."""
        towards = self._images.target.means.new_tensor(view.direction)[None]
        gamma0 = self._images.target.gamma0(towards)[0].cpu().numpy()
        if cloud.name not in self._nearest:
            tree = cKDTree(self._images.target.means.double().cpu().numpy())
            self._nearest[cloud.name] = tree.query(cloud.places_m)[1]
        return gamma0[self._nearest[cloud.name]]

    @cached_property
    def _nearest(self) -> dict[str, np.ndarray]:
        return {}

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        """See `Subject`."""
        return self._images.render(view, ground=ground, shadow=shadow)

    def contributors(self, view: View, pixel: Pixel) -> Contributors | None:
        """See `Subject`: by power."""
        return self._shares(self._images.scene, len(self._images.target), view, pixel)


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
        self._model, self._bare = model.copy(), model.copy(ground=False)
        self._degree, self._grid = degree, grid
        self.scene, self.target = (found.detach() for found in (self._model.scene(degree), self._model.target(degree)))
        self.has_ground = len(self.scene) > len(self.target)
        self.displaced_grid = model.as_displaced(grid)

    def render(self, view: View, *, ground: bool, shadow: bool) -> Float32[np.ndarray, "rows columns"]:
        """β⁰, linear power."""
        if not self.has_ground or (ground and shadow):
            return self._image(self._model, view)
        target = self._image(self._bare, view)
        if not ground:
            return target
        # the noise floor is in both pictures
        return target + self._image(self._model, view, empty=True) - self._image(self._bare, view, empty=True)

    @torch.no_grad()
    def _image(self, model: SceneModel, view: View, *, empty: bool = False) -> Float32[np.ndarray, "rows columns"]:
        rays = RayGrid.for_image(self._grid)
        left_out = torch.ones(len(self.target), dtype=torch.bool, device=model.device) if empty else None
        images, _ = model.render([view], self._grid, self._degree, rays=rays, left_out=left_out)
        found: Float32[np.ndarray, "rows columns"] = images[0].cpu().numpy()
        return found


def gaussian_cloud(target: Gaussians, grid: ImageGrid) -> Cloud:
    """The centres of the Gaussians that are not faint."""
    return Cloud("Gaussians", target.means[target.optical_depth > _FAINT].cpu().numpy(), grid.cell_m / 3)
