"""Nothing suits one size of target: a scene that is larger or smaller in every length is learned alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sarsplat import Config, Dataset, ImageGrid, Run, SarsplatError, preset, reconstruct
from sarsplat.gaussians import MIN_SCALE
from sarsplat.learning.method_sar_gs import lengths
from sarsplat.learning.parts.target import scales_m
from sarsplat.settings.sections import Densification, Rates

SHORT = {"iterations": 30, "gaussians": 600, "harmonics_every": 10, "views_per_step": 4}
DENSITY = Densification(start=5, every=10, gradient=3e-5, max_gaussians=900)
CONFIGS = {
    "default": replace(preset("default"), **SHORT, rates=Rates(means=0.067)),  # of longer steps rounding decides more
    "paper": replace(preset("paper"), **SHORT, densification=DENSITY),
    "measured": replace(preset("measured"), **SHORT),
}


def times(dataset: Dataset, factor: float, config: Config) -> Dataset:
    """The same images of a scene that is larger in every length; where it is said to show ground, a box is given."""
    grid = dataset.grid
    spacing, resolution = ((pair[0] * factor, pair[1] * factor) for pair in (grid.spacing_m, grid.resolution_m))
    low, high = (tuple(factor * value for value in corner) for corner in ((-2.0, -1.5, 0.0), (2.0, 1.5, 1.5)))
    grid = ImageGrid(grid.rows, grid.columns, spacing, resolution)
    return replace(dataset, grid=grid, target_box_m=(low, high) if config.ground else None, truth_mesh=None)


@pytest.fixture(scope="module", params=CONFIGS)
def original(request: pytest.FixtureRequest, dataset: Dataset) -> Run:
    return reconstruct(times(dataset, 1.0, CONFIGS[request.param]), CONFIGS[request.param], quiet=True)


@pytest.mark.parametrize("factor", [10.0, 1 / 15])
def test_a_scaled_scene_is_learned_alike(original: Run, dataset: Dataset, factor: float) -> None:
    scaled = reconstruct(times(dataset, factor, original.config), original.config, quiet=True)
    assert len(original.gaussians) > 600 or original.config.densification is None
    assert [line.gaussians for line in scaled.history] == [line.gaussians for line in original.history]
    losses, expected = (np.array([line.loss for line in run.history]) for run in (scaled, original))
    np.testing.assert_allclose(losses, expected, rtol=1e-3)
    # points at the edge of a voxel or of a cluster come and go with rounding
    assert abs(len(scaled.points) / len(original.points) - 1) < 0.02
    voxel_m = original.config.points.voxel * original.grid.cell_m
    off = cKDTree(original.points).query(scaled.points / factor)[0] / voxel_m
    assert np.median(off) < 0.15
    assert np.quantile(off, 0.95) < 0.8
    for name in ("means", "shift") if original.config.surroundings else ("means",):
        ours, theirs = (run.model.parameters[name].detach() for run in (scaled, original))
        assert float((ours / factor - theirs).norm() / theirs.norm()) < 0.01, name


def test_what_was_chosen_is_told_in_one_line(dataset: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert lengths(Config(), ImageGrid(8, 8, (3.0, 3.0), (3.0, 3.0))) == (
        "lengths from 3 m resolution cells: start 0.6 m, sizes 0.2 … 1.5 m, wider in large scenes, "
        "steps 0.45 → 0.0099 m, rays 1.5, then 0.75 m, voxels 0.15 m"
    )
    config = replace(preset("default"), iterations=1, gaussians=20)
    for quiet in (False, True):
        reconstruct(dataset, config, quiet=quiet)
        shown = capsys.readouterr().out.splitlines()
        assert shown[:1] == ([] if quiet else [lengths(config, dataset.grid)])


def test_cells_whose_gaussians_cannot_be_rendered_are_refused(dataset: Dataset) -> None:
    config = preset("default")
    assert scales_m(config, 1e-3)[0] == MIN_SCALE  # the floor of the engine
    with pytest.raises(SarsplatError, match=r"initial_scale makes Gaussians of 3e-05 m from resolution cells of"):
        reconstruct(times(dataset, 1 / 3000, config), config, quiet=True)
    with pytest.raises(
        SarsplatError, match=r"scale_bounds makes Gaussians of 4\.5e\+06 m .* 0\.0001 m to 1e\+06 m can"
    ):
        reconstruct(times(dataset, 10, config), replace(config, scale_bounds=(0.1, 1e6)), quiet=True)
