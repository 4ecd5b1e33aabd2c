"""Viewer subjects from a folder: a dataset, a run of Gaussians, or a run of another method."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from sarsplat.arguments import checks_arguments
from sarsplat.data import read_dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.points import surface_distance
from sarsplat.geometry import View
from sarsplat.learning.model import SceneModel
from sarsplat.radar import Surface, surface_of_run
from sarsplat.radiometry import white_level
from sarsplat.report.stacks import Interferogram, Pair, spread_m
from sarsplat.runs import Run
from sarsplat.viewer.subject import TRUTH, Cloud, OfScene, Subject, at_most, dataset_subject


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
        points = Cloud("surface points", at_most(self.run.points), self.grid.cell_m / 5)
        if self.truth is None:
            return [points]
        import trimesh

        samples, _ = trimesh.sample.sample_surface(self.truth, 30_000, seed=0)
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
            triangles = np.asarray(self.truth.triangles, np.float64)
            self._errors[cloud.name] = surface_distance(cloud.places_m.astype(np.float64), triangles)
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
