"""Coarse to fine: which images a training looks at, what they show, and where Gaussians become more."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from made import dataset_of, upright
from made_runs import assert_same, trained
from sarsplat import Dataset, Gaussians, ImageGrid, View, preset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import NormalLobes
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import RayGrid
from sarsplat.learning import Trainer
from sarsplat.learning.parts.target import scales_m
from sarsplat.learning.scene_frame import Levels, SceneFrame
from sarsplat.learning.strategies import Info
from sarsplat.learning.strategies.growth import holding
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import render
from sarsplat.settings import Config

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
def config() -> Config:
    return replace(preset("quick"), iterations=12, gaussians=300, checkpoint_every=10)


def levels(side_m: float, iterations: int = 100, coarsest: int = 8, pixels: int = 640) -> Levels:
    grid = ImageGrid(pixels, pixels, (0.3, 0.3), (0.3, 0.3))
    frame = SceneFrame(Region.box((0.0, 0.0, 0.0), (side_m, side_m, 5.0)), 1.0, tuple(VIEWS), grid)
    return Levels.of(replace(preset("default"), iterations=iterations, coarsest=coarsest), frame)


@pytest.mark.parametrize(
    ("side_m", "coarsest", "first"),
    [(7, 4, 1), (11, 4, 1), (13, 4, 2), (30, 8, 4), (900, 8, 8), (900, 64, 16), (900, 1, 1)],
)
def test_the_first_images_are_as_coarse_as_the_target_is_large(side_m: float, coarsest: int, first: int) -> None:
    made = levels(side_m, coarsest=coarsest, pixels=600)
    assert made.factor(0) == first
    assert made.factor(99) == 1


def test_images_of_one_row_are_looked_at_as_they_are() -> None:
    grid = ImageGrid(1, 640, (0.3, 300.0), (0.3, 300.0))
    frame = SceneFrame(Region.box((0.0, 0.0, 0.0), (9e4, 9e4, 5.0)), 1.0, tuple(VIEWS), grid)
    assert Levels.of(preset("default"), frame).coarsest == 1


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


def test_blocks_are_no_larger_than_the_image() -> None:
    with pytest.raises(SarsplatError, match="90 × 91 pixels has no blocks of 91 × 91; give a factor from 1 to 90"):
        GRID.multilooked(91)


def test_a_training_looks_at_finer_images_and_splits_what_they_ask_for(scene: Dataset, config: Config) -> None:
    trainer, seen = Trainer(scene, config), []
    largest = float(trainer.gaussians.scales.max())
    for _ in range(config.iterations):
        trainer.step()
        seen.append((trainer.images.grid.rows, len(trainer.model)))
    rows, counts = zip(*seen, strict=True)
    assert rows == (45,) * 9 + (90,) * 3  # 42 m are not enough for 4
    assert set(counts[:9]) == {300}
    assert 300 < counts[9] < 600
    assert largest == pytest.approx(0.2 * GRID.multilooked(2).cell_m)
    assert trainer.grid == GRID
    largest = scales_m(config, GRID.cell_m, 2)[2]
    assert largest == pytest.approx(config.scale_bounds[1] * GRID.cell_m * 2 ** (1 / 6))  # wider, as the scene is large
    assert trainer.model.learned["scales"].high == largest
    assert float(trainer.gaussians.scales.max()) <= largest * (1 + 1e-6)


def test_a_training_that_stopped_on_any_level_goes_on_the_same(scene: Dataset, config: Config) -> None:
    whole = trained(scene, config, config.iterations).snapshot(0.0)
    for stop in (4, 9, 10):
        stopped = trained(scene, config, stop).snapshot(0.0)
        assert_same(trained(scene, config, config.iterations - stop, stopped).snapshot(0.0), whole)


def test_those_that_hold_most_of_the_error_are_the_fewest() -> None:
    errors = torch.tensor([1.0, 8.0, 0.0, 0.5, 0.5])
    assert holding(errors, 0.8).tolist() == [False, True, False, False, False]
    assert holding(errors, 0.9).tolist() == [True, True, False, False, False]
    assert not holding(torch.zeros(3), 0.9).any()


def test_those_that_look_wrong_have_the_error(scene: Dataset, config: Config) -> None:
    truth = plates()
    trainer = Trainer(scene, replace(config, gaussians=len(truth), coarsest=1))
    parameters = trainer.model.parameters
    with torch.no_grad():
        for name, tensor in truth.tensors().items():
            parameters[name].copy_(tensor[:, :2] if name == "scattering" else tensor)  # the exponent is the usual one
        parameters["scattering"][1] += 2.0
    _, rendering = trainer.model.render(trainer.views, GRID, 0)
    info = Info(trainer.model, trainer.images, (0,), rendering, 0, trainer._rays, trainer._bounds, trainer._generator)
    errors = info.errors()
    assert float(errors[1] / errors.sum()) > 0.95
    assert holding(errors, 0.9).nonzero().tolist() == [[1]]
