"""Coarse to fine: which images a training looks at, and that nothing suits one size of target alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from made import dataset_of, upright
from made_runs import assert_same, trained
from sarsplat import Config, Dataset, Gaussians, ImageGrid, RayGrid, SarsplatError, View, preset, reconstruct
from sarsplat.gaussians import MIN_SCALE, NormalLobes
from sarsplat.gaussians.initialise import Region
from sarsplat.learning import Trainer
from sarsplat.learning.method_sar_gs import lengths
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.target import scales_m
from sarsplat.learning.scene_frame import Levels, SceneFrame
from sarsplat.learning.strategies import Info, State
from sarsplat.learning.strategies.growth import Growing, holding
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import render
from sarsplat.settings.sections import Densification, Rates

GRID = ImageGrid(90, 91, (0.5, 0.5), (0.6, 0.5))
VIEWS = [View(azimuth, grazing) for azimuth, grazing in ((0, 35), (90, 50), (180, 35), (270, 50))]


def plates() -> Gaussians:
    """Two of them, 20 m apart, and many small things on one."""
    generator = torch.Generator().manual_seed(0)
    small = torch.rand(60, 3, generator=generator) * torch.tensor([9.0, 9.0, 1.0]) + torch.tensor([-14.0, -4.5, 0.5])
    means = torch.cat([torch.tensor([[-10.0, 0.0, 0.3], [10.0, 0.0, 0.3]]), small])
    scales = torch.cat([torch.tensor([[3.0, 3.0, 0.05]] * 2), torch.full((len(small), 3), 0.15)])
    return upright(means, scales, 3.0, NormalLobes.initial(len(means), 0.5, 0.0))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    images = render(plates(), VIEWS, GRID).images[:, 0].numpy()
    return dataset_of(GRID, [(view, "train") for view in VIEWS], images)


@pytest.fixture(scope="module")
def coarse() -> Config:
    return replace(preset("quick"), iterations=12, gaussians=300, checkpoint_every=10)


@pytest.mark.parametrize("factor", [0.3, 3e4])
def test_the_first_renderings_have_a_share_of_the_images_power(scene: Dataset, coarse: Config, factor: float) -> None:
    many, truth = replace(coarse, gaussians=None), factor * scene.power
    model = SceneModel.initial(many, replace(scene, power=truth), torch.Generator().manual_seed(0))
    images = render(model.target(0).detach(), VIEWS, GRID).images[:, 0]
    powers = images.sum((1, 2)).numpy() * model.unit / truth.sum((1, 2))
    assert np.quantile(powers, 0.25) == pytest.approx(many.initial_scattering, rel=0.1)


def levels(side_m: float, iterations: int = 100, coarsest: int = 8, rows: int = 640, pixel_m: float = 0.3) -> Levels:
    grid = ImageGrid(rows, 640, (0.3, pixel_m), (0.3, pixel_m))
    frame = SceneFrame(Region.box((0.0, 0.0, 0.0), (side_m, side_m, 5.0)), 1.0, tuple(VIEWS), grid)
    return Levels.of(replace(preset("default"), iterations=iterations, coarsest=coarsest), frame)


@pytest.mark.parametrize(
    ("side_m", "coarsest", "first"),
    [(7, 4, 1), (11, 4, 1), (13, 4, 2), (30, 8, 4), (900, 8, 8), (900, 64, 16), (900, 1, 1)],
)
def test_the_first_images_are_as_coarse_as_the_target_is_large(side_m: float, coarsest: int, first: int) -> None:
    made = levels(side_m, coarsest=coarsest, rows=600)
    assert made.factor(0) == first
    assert made.factor(99) == 1
    assert levels(9e4, rows=1, pixel_m=300.0).coarsest == 1  # images of one row


def test_levels_follow_each_other_and_the_last_has_the_least_time() -> None:
    made = levels(100.0, coarsest=4)
    factors = [made.factor(k) for k in range(100)]
    assert factors == sorted(factors, reverse=True)
    assert [factors.count(f) for f in (4, 2, 1)] == [38, 37, 25]
    assert [k for k in range(100) if made.growths(k + 1) > made.growths(k)] == [38, 56, 75]
    assert made.growths(100) == 3
    assert not levels(7.0).growths(100)
    assert [k for k in range(100) if made.fine(k, 0.6)] == list(range(90, 100))  # of the last ones alone
    assert [k for k in range(100) if levels(7.0).fine(k, 0.6)] == list(range(60, 100))
    assert levels(100.0, iterations=1).factor(0) == 8  # however short


@pytest.mark.parametrize("factor", [2, 4])
def test_a_scene_on_the_coarse_grid_is_what_the_means_show(scene: Dataset, factor: int) -> None:
    looked = TrainingImages(scene, torch.device("cpu")).multilooked(factor, scene.select("train").views)
    assert looked.truth.shape == (4, 90 // factor, 91 // factor)
    block = scene.power[1, 3 * factor : 4 * factor, 2 * factor : 3 * factor]
    assert float(looked.truth[1, 3, 2]) == pytest.approx(float(block.mean()))

    def error(grid: ImageGrid) -> float:
        shown = render(plates(), VIEWS, grid, rays=RayGrid.for_image(GRID)).images[:, 0]
        return float((shown - looked.truth).norm() / looked.truth.norm())

    assert error(looked.grid) < 0.03
    assert error(replace(looked.grid, resolution_m=GRID.resolution_m)) > 2 * error(looked.grid)


def test_a_training_looks_at_finer_images_and_splits_what_they_ask_for(scene: Dataset, coarse: Config) -> None:
    trainer, seen = Trainer(scene, coarse), []
    largest = float(trainer.gaussians.scales.max())
    for _ in range(coarse.iterations):
        trainer.step()
        seen.append((trainer.images.grid.rows, len(trainer.model)))
    rows, counts = zip(*seen, strict=True)
    assert rows == (45,) * 9 + (90,) * 3  # 42 m are not enough for 4
    assert set(counts[:9]) == {300}
    assert 300 < counts[9] < 600
    assert largest == pytest.approx(0.2 * GRID.multilooked(2).cell_m)
    assert trainer.grid == GRID
    largest = scales_m(coarse, GRID.cell_m, 2)[2]
    assert largest == pytest.approx(coarse.scale_bounds[1] * GRID.cell_m * 2 ** (1 / 6))  # wider, as the scene is large
    assert trainer.model.learned["scales"].high == largest
    assert float(trainer.gaussians.scales.max()) <= largest * (1 + 1e-6)


def test_points_of_a_large_scene_lie_at_the_depth_of_smoothed_surfaces(scene: Dataset, coarse: Config) -> None:
    depths = [{"points.optical_depth": 0.5, "points.smoothed_depth": depth} for depth in (5.0, 0.05)]
    deep, shallow = (reconstruct(scene, coarse.with_settings(one), quiet=True).points for one in depths)
    assert len(deep) < 0.8 * len(shallow)


def test_a_training_that_stopped_on_any_level_goes_on_the_same(scene: Dataset, coarse: Config) -> None:
    whole = trained(scene, coarse, coarse.iterations).snapshot(0.0)
    for stop in (4, 9, 10):
        stopped = trained(scene, coarse, stop).snapshot(0.0)
        assert_same(trained(scene, coarse, coarse.iterations - stop, stopped).snapshot(0.0), whole)


def test_those_that_hold_most_of_the_error_are_the_fewest() -> None:
    errors = torch.tensor([1.0, 8.0, 0.0, 0.5, 0.5])
    assert holding(errors, 0.8).tolist() == [False, True, False, False, False]
    assert holding(errors, 0.9).tolist() == [True, True, False, False, False]
    assert not holding(torch.zeros(3), 0.9).any()


def test_those_that_look_wrong_have_the_error_and_are_split_instead_of_hidden_ones(
    scene: Dataset, coarse: Config
) -> None:
    trainer = Trainer(scene, replace(coarse, iterations=16, gaussians=len(plates())))
    truth = replace(plates(), scattering=plates().scattering.times(1 / trainer.model.unit))
    parameters, below = trainer.model.parameters, torch.tensor([-10.0, 0.0, -0.3])
    with torch.no_grad():
        for name, tensor in truth.tensors().items():
            parameters[name].copy_(tensor[:, :2] if name == "scattering" else tensor)  # the exponent is the usual one
        parameters["scattering"][1] += 2.0
    _, rendering = trainer.model.render(trainer.views, GRID, 0)
    info = Info(trainer.model, trainer.images, (0,), rendering, 0, trainer._rays, trainer._bounds, trainer._generator)
    errors = info.errors()
    assert float(errors[1] / errors.sum()) > 0.95
    assert holding(errors, 0.9).nonzero().tolist() == [[1]]
    parameters["means"].detach()[2:32], parameters["optical_depth"].detach()[2:32] = below, 0.5
    Growing(coarse, scene).step_post_backward(
        parameters, trainer.optimiser, State(whole={"times": torch.tensor(9)}), 9, info
    )
    assert not (parameters["means"] == below).all(1).any()
    assert len(trainer.model) == 62  # as before


# ---- a scene that is larger or smaller in every length is learned alike ----------------------------------------------
SHORT = {"iterations": 20, "gaussians": 600, "harmonics_every": 10, "views_per_step": 4}
DENSITY = Densification(start=5, every=10, gradient=3e-5, max_gaussians=900)
DEFAULT = replace(preset("default"), **SHORT, rates=Rates(means=0.067))  # of longer steps rounding decides more


def times(dataset: Dataset, factor: float, config: Config) -> Dataset:
    """The same images of a scene that is larger in every length; where it is said to show ground, a box is given."""
    spacing, resolution, low, high = (
        tuple(factor * value for value in values)
        for values in (dataset.grid.spacing_m, dataset.grid.resolution_m, (-2.0, -1.5, 0.0), (2.0, 1.5, 1.5))
    )
    grid = ImageGrid(dataset.grid.rows, dataset.grid.columns, spacing, resolution)
    return replace(dataset, grid=grid, target_box_m=(low, high) if config.ground else None, truth_mesh=None)


@pytest.mark.parametrize(
    ("config", "factor"),
    [
        (DEFAULT, 10.0),
        (DEFAULT, 1 / 15),
        (replace(preset("paper"), **SHORT, densification=DENSITY), 1 / 15),
        (replace(preset("measured"), **SHORT | {"iterations": 30}), 10.0),  # shifts agree less after 20
    ],
    ids=["default-larger", "default-smaller", "paper-smaller", "measured-larger"],
)
def test_a_scaled_scene_is_learned_alike(config: Config, factor: float, dataset: Dataset) -> None:
    original, scaled = (reconstruct(times(dataset, size, config), config, quiet=True) for size in (1.0, factor))
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
    with pytest.raises(SarsplatError, match=r"scale_bounds makes Gaussians of 4\.5e\+06 m .* 0\.0001 m to 1e\+06 m"):
        reconstruct(times(dataset, 10, config), replace(config, scale_bounds=(0.1, 1e6)), quiet=True)
