"""Subjects of the viewer: a run, a dataset or a training, and their common interface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, read_dataset
from sarsplat.data.outliers import outliers
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.points import on_surface
from sarsplat.extras import Trimesh
from sarsplat.gaussians import Gaussians, Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning import Trainer
from sarsplat.learning.model import SceneModel
from sarsplat.radar import Pixel, RadarMaps, Surface, contributions, radar_maps, surface_of_mesh, surface_of_run
from sarsplat.radiometry import white_level
from sarsplat.regions.target_region import target_region
from sarsplat.renderer import GroundBounce
from sarsplat.report.stacks import Interferogram, Pair, spread_m
from sarsplat.runs import Run
from sarsplat.runs.own_gaussians import own_scene
from sarsplat.scenes import ScatteringLaw, law_by_ground
from sarsplat.scenes.meshes import read_mesh
from sarsplat.scenes.surface_samples import surface_samples

TRUTH = "true surface"
"""Name of the cloud of the true surface."""

_MAX_POINTS = 60_000  # maximum number of points drawn
_ONE_DIRECTION = 1e-12  # tolerance of cosines of equal directions
_FAINT = 0.05  # optical depth below which a Gaussian is not drawn


@dataclass(frozen=True)
class Cloud:
    """Named places in the world, m, and the size of their dots, m."""

    name: str
    places_m: Float32[np.ndarray, "n 3"]
    size_m: float


@dataclass(frozen=True)
class Contributors:
    """Contributors to a pixel: places with their shares, largest first, and the share of the learned ground.

    `by_ground_share` is the part of the places' shares that returns by way of the ground.
    """

    places_m: Float[np.ndarray, "n 3"]
    shares: Float[np.ndarray, " n"]
    ground_share: float
    by_ground_share: float


class Subject:
    """Dataset, and a run of it if any; `dataset` is None if its images are missing. `peak` is the power shown white."""

    renders = scatters = knows_errors = knows_phases = False
    """True if `render`, `gamma0`, `error_m`, `interferogram` are implemented."""

    has_ground = False
    """True if ground was learned, which can be hidden."""

    def __init__(
        self, title: str, grid: ImageGrid, train_views: tuple[View, ...], peak: float, dataset: Dataset | None
    ) -> None:
        self.title, self.grid, self.train_views, self.peak, self.dataset = title, grid, train_views, peak, dataset

    # ---- dataset ----------------------------------------------------------------------------------------------------
    @property
    def speckled(self) -> bool:
        """True if the dataset's images are speckled."""
        return self.dataset is not None and self.dataset.looks is not None

    @property
    def views(self) -> list[tuple[View, str]]:
        """Every known view with the name of its set."""
        if self.dataset is None:
            return [(view, "train") for view in self.train_views]
        return [(entry.view, entry.split) for entry in self.dataset.entries]

    def nearest(self, view: View) -> tuple[int, float]:
        """Nearest known view: its index in `views`, and the angle to it, degrees.

        Of views from one direction, the one with the most similar frame is chosen.
        """
        cosines = self._directions @ view.direction
        nearest = np.flatnonzero(cosines >= cosines.max() - _ONE_DIRECTION)
        index = int(max(nearest, key=lambda k: float((self.views[k][0].look.frame * view.look.frame).sum())))
        chord = math.dist(self._directions[index], view.direction)  # arccos loses the digits of small angles
        return index, math.degrees(2 * math.asin(min(chord / 2, 1.0)))

    @cached_property
    def _directions(self) -> Float[np.ndarray, "v 3"]:
        return np.stack([view.direction for view, _ in self.views])

    @cached_property
    def truth(self) -> Trimesh | None:
        """True surface, if it is known and can be read."""
        if self.dataset is None or self.dataset.truth_mesh is None:
            return None
        try:
            return read_mesh(self.dataset.truth_mesh)
        except SarsplatError:
            return None

    # ---- views and clouds -------------------------------------------------------------------------------------------
    @cached_property
    def clouds(self) -> list[Cloud]:
        """Clouds for the scene, the best first."""
        if self.surface is None:
            return []
        places = self.surface.gaussians.means.numpy()
        return [Cloud(TRUTH, _at_most(places), self.grid.cell_m / 2)]

    @cached_property
    def surface(self) -> Surface | None:
        """Surface for radar maps, or None."""
        return None if self.truth is None else surface_of_mesh(self.truth, self.grid.cell_m)

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """γ⁰ of every place of a cloud towards the radar, linear; needs `scatters`."""
        raise NotImplementedError

    def error_m(self, cloud: Cloud) -> Float[np.ndarray, " n"]:
        """Distance of every place of a cloud from the true surface, m; needs `knows_errors`."""
        raise NotImplementedError

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        """β⁰ of a view, linear power; needs `renders`. Without `shadow`, target and ground are rendered separately."""
        raise NotImplementedError

    def interferogram(self, view: View) -> tuple[Interferogram, Pair]:
        """Learned interferogram of two passes from any view, and the pair; needs `knows_phases`."""
        raise NotImplementedError

    # ---- contributors to a pixel ------------------------------------------------------------------------------------
    @property
    def maps_grid(self) -> ImageGrid:
        """Grid of the images relative to an undisplaced scene."""
        return self.grid

    def maps(self, view: View) -> RadarMaps | None:
        """Radar maps of a view that is not stretched, if the target's shape is known."""
        return None if self.surface is None or view.stretch != 1 else radar_maps(self.surface, view, self.maps_grid)

    def contributors(self, view: View, pixel: Pixel) -> Contributors | None:
        """Contributors to a pixel, by area alone, and by way of the ground if that was simulated."""
        surface = self.surface
        if surface is None:
            return None
        bounce, reflectivity = None, self.dataset.source.get("ground_reflectivity") if self.dataset else None
        if reflectivity:
            towards = torch.from_numpy(view.look.facing).float()[None]
            sides = torch.from_numpy(law_by_ground(surface.normals, [view], ScatteringLaw(1.0, 0.0))).float()
            sent_on = surface.gaussians.gamma0(towards) * sides
            bounce = GroundBounce(Ground(torch.tensor(0.0)), torch.tensor(float(reflectivity)), sent_on)
        return self._shares(surface.gaussians, len(surface.normals), view, pixel, bounce)

    def _shares(
        self, scene: Gaussians, target: int, view: View, pixel: Pixel, bounce: GroundBounce | None = None
    ) -> Contributors | None:
        power = contributions(scene, view, self.maps_grid, pixel)
        by_ground = np.zeros_like(power)
        if bounce is not None:
            by_ground = contributions(scene, view, self.maps_grid, pixel, bounce=bounce)
        power = power + by_ground
        total = float(power.sum())
        if not total > 0:
            return None
        order = power[:target].argsort()[::-1]
        order = order[power[order] > 0]
        places = scene.means.double().cpu().numpy()[order]
        shares = float(power[target:].sum()) / total, float(by_ground.sum()) / total
        return Contributors(places, power[order] / total, *shares)

    @property
    def box_m(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Corners of the target's bounding box, m; without a shape, estimated from the images."""
        if self.clouds and len(self.clouds[0].places_m):
            cloud = self.clouds[0].places_m
            cloud = cloud[~outliers(cloud)]
            low, high = np.quantile(cloud.astype(np.float64), (0.002, 0.998), axis=0)
            return np.minimum(low - self.grid.cell_m, [np.inf, np.inf, 0.0]), high + self.grid.cell_m
        if self.dataset is not None:
            region = target_region(self.dataset, ground=self.dataset.ground or self.speckled)
            return region.low, region.high
        half = min(self.grid.rows * self.grid.spacing_m[1], self.grid.columns * self.grid.spacing_m[0]) / 4
        return np.array([-half, -half, 0.0]), np.array([half, half, half])


def dataset_subject(dataset: Dataset) -> Subject:
    """Subject of a dataset's images, and of its true surface if known."""
    train = dataset.select("train")
    name = dataset.path.name if dataset.path else dataset.target
    return Subject(f"{name}: dataset of {dataset.target}", dataset.grid, train.views, white_level(train.power), dataset)


def _at_most(places: Float[np.ndarray, "p 3"]) -> Float32[np.ndarray, "n 3"]:
    """All places, or as many random ones as are drawn."""
    places = places.astype(np.float32, copy=False)
    few = len(places) <= _MAX_POINTS
    return places if few else places[np.random.default_rng(0).permutation(len(places))[:_MAX_POINTS]]


# ---- scenes of Gaussians ---------------------------------------------------------------------------------------------
class OfScene(Subject):
    """Subject of a scene of Gaussians, with or without its ground and the shadow on it."""

    renders = True
    scatters = True

    def look_at(self, model: SceneModel, degree: int) -> None:
        """Set the scene (copied, since training may continue) and the degree of its harmonics."""
        self._model, self._groundless, self._degree = model.copy(), model.copy(ground=False), degree
        self.target = self._model.target(degree).detach()
        self.has_ground = model.ground() is not None
        self._nearest: dict[str, np.ndarray] = {}

    @property
    def maps_grid(self) -> ImageGrid:
        return self._model.as_displaced(self.grid)

    @cached_property
    def gaussian_cloud(self) -> Cloud:
        """Centres of the Gaussians that are not faint."""
        places = self.target.means[self.target.optical_depth > _FAINT]
        return Cloud("Gaussians", places.cpu().numpy(), self.grid.cell_m / 3)

    def gamma0(self, cloud: Cloud, view: View) -> Float[np.ndarray, " n"]:
        """γ⁰ of the Gaussian nearest to each place."""
        if cloud.name not in self._nearest:
            self._nearest[cloud.name] = cKDTree(self.target.means.double().cpu().numpy()).query(cloud.places_m)[1]
        towards = self.target.means.new_tensor(view.look.facing)[None]
        gamma0: Float[np.ndarray, " n"] = self.target.gamma0(towards)[0].cpu().numpy()[self._nearest[cloud.name]]
        return self._model.unit * gamma0

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
        """Contributors to a pixel, by power."""
        bounces = [echo for echo in self._model.echoes() if isinstance(echo, GroundBounce)]
        return self._shares(self.target, len(self.target), view, pixel, bounces[0] if bounces else None)


class SceneAlone(OfScene):
    """Subject of Gaussians without a run."""

    surface = None  # normals would take seconds

    @cached_property
    def clouds(self) -> list[Cloud]:
        return [self.gaussian_cloud]


def scene_of(
    gaussians: Gaussians, grid: ImageGrid | None = None, views: Sequence[View] | None = None, peak: float | None = None
) -> SceneAlone:
    """Subject of given Gaussians; grid, views and the power shown white have defaults."""
    config, snapshot = own_scene(gaussians, grid, views, peak, 0.0)
    peak = peak or snapshot.brightest
    scene = SceneAlone(f"{len(gaussians):,} Gaussians", snapshot.grid, snapshot.views, peak, None)
    scene.look_at(SceneModel.saved(snapshot, config), config.harmonics_degree)
    return scene


def training_subject(dataset: Dataset, trainer: Trainer) -> SceneAlone:
    """Subject of a training between two steps, copied."""
    title = f"{dataset.target}: training, {trainer.iteration:,} steps, {trainer.gaussian_count:,} Gaussians"
    images = dataset_subject(dataset)
    scene = SceneAlone(title, images.grid, images.train_views, images.peak, dataset)
    scene.look_at(trainer.model, trainer.model.degree(trainer.iteration))
    return scene


# ---- runs ---------------------------------------------------------------------------------------------------------
class RunSubject(Subject):
    """Subject of a run of any method."""

    renders = True

    def __init__(self, run: Run) -> None:
        self.run = run
        try:
            dataset = run.dataset
        except SarsplatError:  # rendering needs no images
            dataset = None
        peak = run.brightest if dataset is None else white_level(dataset.images("train"))
        name = "a run" if run.path is None else run.path.name
        super().__init__(f"{name}: {run.learned}", run.grid, run.snapshot.views, peak, dataset)
        self.knows_errors = self.truth is not None
        self.knows_phases = any(stack.interferometric for stack in run.snapshot.stacks)  # all are, or none
        self._errors: dict[str, Float[np.ndarray, " n"]] = {}

    @cached_property
    def clouds(self) -> list[Cloud]:
        points = Cloud("surface points", _at_most(self.run.points), self.grid.cell_m / 5)
        if self.truth is None:
            return [points]
        samples = surface_samples(self.truth, 30_000, np.random.default_rng(0))
        return [points, Cloud(TRUTH, np.asarray(samples, np.float32), self.grid.cell_m / 5)]

    @cached_property
    def surface(self) -> Surface | None:
        try:
            return surface_of_run(self.run)
        except SarsplatError:  # the run has no surface
            return None

    def error_m(self, cloud: Cloud) -> Float[np.ndarray, " n"]:
        assert self.truth is not None
        if cloud.name not in self._errors:
            self._errors[cloud.name], _ = on_surface(cloud.places_m, np.asarray(self.truth.triangles, np.float64))
        return self._errors[cloud.name]

    def interferogram(self, view: View) -> tuple[Interferogram, Pair]:
        """Interferogram of two passes like those of the nearest training view."""
        cosines = [known.direction @ view.direction for known in self.train_views]
        stack = self.run.snapshot.stacks[int(np.argmax(cosines))]
        pair = Pair.longest(stack, view, spread_m(self.run.points))
        two = replace(
            stack,
            offsets_rad=tuple(stack.offsets_rad[k] for k in (pair.first, pair.second)),
            polarisations=None,
            noise=None,
        )
        covariances = self.run.render_covariances([view], two)[0]
        parts = Pair(0, 1, pair.cycle_m).of(covariances, two.plane_phases(view, self.grid))
        return Interferogram.of(parts), pair

    def render(self, view: View, *, ground: bool = True, shadow: bool = True) -> Float32[np.ndarray, "rows columns"]:
        return self.run.render([view])[0]


class GaussianSubject(OfScene, RunSubject):
    """Subject of a run of Gaussians."""

    def __init__(self, run: Run, model: SceneModel) -> None:
        super().__init__(run)
        self.look_at(model, model.degree(run.iteration))

    @cached_property
    def clouds(self) -> list[Cloud]:
        points, *others = super().clouds
        return [points, self.gaussian_cloud, *others]


@checks_arguments
def subject_at(path: str | Path) -> Subject:
    """Open the run or dataset in a folder as a subject."""
    path = Path(path)
    if (path / "config.json").is_file():
        return subject_of_run(Run.load(path))
    if (path / "dataset.json").is_file():
        return dataset_subject(read_dataset(path))
    problem = "does not exist" if not path.exists() else "is neither a run nor a dataset"
    raise SarsplatError(
        f"{path} {problem}; give the folder of one, which `sarsplat simulate` or `sarsplat reconstruct` writes"
    )


def subject_of_run(run: Run) -> Subject:
    """Subject of a run of any method; its dataset may be missing."""
    return RunSubject(run) if run.model is None else GaussianSubject(run, run.model)
