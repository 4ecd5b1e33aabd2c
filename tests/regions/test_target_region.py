"""Where the target is looked for: what was given, else the box of what stands out in the images."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from made import dataset_of
from sarsplat import Dataset, ImageGrid, SarsplatError, SarsplatWarning, View, radar_frame, reconstruct
from sarsplat.gaussians.initialise import Region
from sarsplat.regions.target_box import target_box
from sarsplat.regions.target_region import cut_off, target_region
from sarsplat.settings import Config

VIEWS = [View(azimuth, 40.0) for azimuth in range(0, 360, 45)]
GRID = ImageGrid(40, 40, (0.3, 0.3), (0.4, 0.4))


def on_ground(grid: ImageGrid, power: np.ndarray) -> Dataset:
    return dataset_of(grid, [(view, "train") for view in VIEWS], power, ground=True)


def pixel_of(view: View, distance_m: float, middle: int) -> tuple[int, int]:
    """Row and column of a place on the x axis, in images of pixels of 0.3 m with this middle."""
    azimuth = np.radians(view.azimuth_deg)
    row = middle - distance_m * np.cos(azimuth) * np.cos(np.radians(40.0)) / 0.3
    return round(row), round(middle - distance_m * np.sin(azimuth) / 0.3)


@pytest.fixture
def shown() -> Dataset:
    """Something bright in the middle, and something as bright at its edge, on the ground."""
    power = np.ones((len(VIEWS), 40, 40), np.float32)
    power[:, 17:23, 17:23] = 30
    for k, view in enumerate(VIEWS):
        row, column = pixel_of(view, 4.0, 20)
        power[k, row - 2 : row + 3, column - 2 : column + 3] = 30
    return on_ground(GRID, power)


INNER = (-1.5, -1.5, 0.0, 1.5, 1.5, 1.0)


def test_a_box_of_the_settings_precedes_the_datasets_and_that_the_images(shown: Dataset) -> None:
    found = target_region(shown, ground=True)
    assert (found.high[:2] > 1).all()
    theirs = replace(shown, target_box_m=((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0)))
    for ground in (True, False):
        assert target_region(theirs, ground=ground).high.tolist() == [2, 2, 2]
        own = target_region(theirs, ground=ground, box=Config(target_box=INNER).box_m)
        assert (own.low.tolist(), own.high.tolist()) == ([-1.5, -1.5, 0], [1.5, 1.5, 1])


def test_what_stands_out_beyond_the_box_is_said_and_speckle_is_not(shown: Dataset) -> None:
    (said,) = cut_off(Region.box(INNER[:3], INNER[3:]), 0.3, shown)
    assert "of the brightness above the ground lies outside of the box" in said
    assert "give another `target_box`" in said
    assert cut_off(Region.box((-5.0, -5.0, 0.0), (5.0, 5.0, 1.0)), 0.3, shown) == []
    power = np.random.default_rng(0).exponential(size=(len(VIEWS), 40, 40)).astype(np.float32)
    power[:, 17:23, 17:23] *= 30
    speckled = on_ground(GRID, power)
    assert cut_off(target_region(speckled, ground=True), 0.3, speckled) == []


def test_every_object_is_in_the_box_and_what_stands_beside_a_given_one_is_said() -> None:
    grid, power = ImageGrid(64, 64, (0.3, 0.3), (0.4, 0.4)), np.ones((len(VIEWS), 64, 64), np.float32)
    for k, view in enumerate(VIEWS):
        row, column = pixel_of(view, 6.0, 32)
        power[k, row - 1 : row + 2, column - 1 : column + 2] = 30
        power[k, 26:38, 26:38] = 100
    dataset = on_ground(grid, power)
    (said,) = cut_off(Region.box((-3, -3, 0), (3, 3, 2)), 0.0, dataset)
    assert said.startswith("what stands at x 5")
    assert " is outside of the box it is looked for in (" in said
    around = tuple(float(word) for word in said.partition("target_box=(")[2].partition(")")[0].split(", "))
    assert around[3] > 6
    assert cut_off(Region.box(around[:3], around[3:]), 0.0, dataset) == []
    assert target_region(dataset, ground=True).high[0] > 6
    power[:, 26:38, 26:38] = 1e5  # beside which it may be a response of glints
    assert cut_off(target_region(dataset, ground=True), 0.0, dataset) == []


def test_gaussians_stay_in_the_given_box_and_a_run_keeps_it(shown: Dataset) -> None:
    config = Config(target_box=INNER, iterations=3, gaussians=50)
    with pytest.warns(SarsplatWarning, match="brightness above the ground"):
        run = reconstruct(shown, config, quiet=True)
    reach = 1.5 + config.margin * GRID.cell_m
    assert float(run.gaussians.means[:, :2].abs().max()) <= reach + 1e-6


# ---- the box of what stands out from the ground ----------------------------------------------------------------------
Slab = tuple[float, float, float, float]
"""Something bright on the ground: x from … to, y from … to, m."""

Solid = tuple[Slab, float]
"""The same, with its height, m."""

CHIP = ImageGrid(120, 100, (0.2, 0.22), (0.3, 0.32))
ALL_AROUND = [View(azimuth, 17.0) for azimuth in range(0, 360, 30)]
TANK: list[Solid] = [((-3.5, 3, -1.7, 1.7), 1.2), ((-1, 1.2, -1.2, 1.2), 2.2), ((3, 5.5, -0.2, 0.2), 1.2)]


def images(
    slabs: Sequence[Slab | Solid],
    views: Sequence[View],
    grid: ImageGrid,
    power: float = 20.0,
    speckle: bool = True,
    shadow: float = 0.0,
) -> np.ndarray:
    """Ground with brighter parts, as it lies in slant range; every image has a gain of its own."""
    solids = tuple(slab if len(slab) == 2 else (slab, 0.0) for slab in slabs)
    chance, stack = np.random.default_rng(0), []
    for view in views:
        mean = clean(solids, view, grid, power, shadow)
        drawn = chance.exponential(size=mean.shape) if speckle else 1.0
        stack.append(chance.uniform(0.3, 3) * mean * drawn)
    return np.stack(stack).astype(np.float32)


@cache
def clean(solids: Sequence[Solid], view: View, grid: ImageGrid, power: float, shadow: float) -> np.ndarray:
    """What is high is displaced towards the radar, and behind it is shadow."""
    frame = radar_frame(view)
    image = np.stack(np.meshgrid(grid.azimuth_m, grid.range_m))
    x, y = np.tensordot(np.linalg.inv(frame[[0, 2]][:, :2]), image, 1)  # z = 0
    away = frame[2, :2] / np.linalg.norm(frame[2, :2])
    tangent = np.tan(np.radians(view.grazing_deg))
    mean = np.ones(x.shape)
    for behind, level in ((-1 / tangent, shadow), (tangent, power)):
        for (x0, x1, y0, y1), height in solids:
            for z in np.arange(0, height + 0.01, max(0.1, height / 10)):
                dx, dy = behind * z * away
                mean[(x0 - dx < x) & (x < x1 - dx) & (y0 - dy < y) & (y < y1 - dy)] = level
    return mean


def check(slab: Slab, low: np.ndarray, high: np.ndarray, cell: float) -> None:
    """It contains the slab, and is larger by no more than five cells each way."""
    for axis, (first, last) in enumerate((slab[:2], slab[2:])):
        assert first - 5 * cell < low[axis] <= first
        assert last <= high[axis] < last + 5 * cell
    assert low[2] == 0


SLAB = (-3, 4, -1.5, 1)
FOUR = [View(0, 30), View(90, 30), View(180, 50), View(270, 15)]


@pytest.mark.parametrize(
    ("slab", "views", "factor"),
    [
        *((slab, ALL_AROUND, 1.0) for slab in (SLAB, (-1, 1, -1, 1), (2, 5, 1, 6))),
        *((SLAB, ALL_AROUND, factor) for factor in (20.0, 1 / 15)),
        (SLAB, FOUR, 1.0),
    ],
)
def test_it_contains_the_target_and_little_more_in_scenes_of_any_size(slab, views, factor) -> None:
    grid = ImageGrid(120, 100, (0.2 * factor, 0.22 * factor), (0.3 * factor, 0.32 * factor))
    slab = tuple(factor * side for side in slab)
    low, high = target_box(images([slab], views, grid), views, grid)
    check(slab, low, high, 0.31 * factor)
    assert high[2] == pytest.approx(0.65 * (high - low)[:2].min())  # no shadow tells it


STEEP_TOO = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (15, 45, 75)]
TWENTY = [View(azimuth, 20.0) for azimuth in range(7, 360, 15)]
STEEP = [View(azimuth, 70.0) for azimuth in range(0, 360, 30)]


@pytest.mark.parametrize(
    ("views", "options", "share", "more_m"),
    [
        *((views, {"speckle": speckle}, 0, 4.06) for views in (STEEP_TOO, TWENTY[::3]) for speckle in (False, True)),
        (STEEP, {}, 1, 0.32),  # they leave the height open
        (TWENTY, {"shadow": 0.5}, 0.65, 1e-6),  # a shadow that is hardly dark does not tell the height
    ],
)
def test_nothing_of_what_is_high_lies_outside_and_little_is_beside_it_or_above(
    views: list[View], options: dict[str, float], share: float, more_m: float
) -> None:
    """The height is at most a share of the narrower side and some metres more."""
    low, high = target_box(images(TANK, views, CHIP, **options), views, CHIP)
    check((-3.5, 5.5, -1.7, 1.7), low, high, 0.31)
    most_m = share * (high - low)[:2].min() + more_m
    assert 2.2 <= high[2] < most_m
    assert "shadow" not in options or high[2] == pytest.approx(most_m)


@pytest.mark.parametrize("at", [(0.0, 0.0), (3.0, -4.0)])
def test_a_tower_is_not_cut_off_and_as_high_far_from_the_middle(at: tuple[float, float]) -> None:
    x, y = at
    low, high = target_box(images([((x - 1, x + 1, y - 1, y + 1), 4.5)], TWENTY, CHIP), TWENTY, CHIP)
    assert (low[:2] > np.array(at) - 1 - 4.5 / 2).all()  # it leans towards every view
    assert (low[:2] <= np.array(at) - 1).all() and (high[:2] >= np.array(at) + 1).all()
    assert 4.5 <= high[2] < 6


HOUSES: list[Solid] = [((-9, -2, 1, 8), 4.0), ((1, 9, -9, -1), 6.0), ((2, 8, 2, 9), 3.0), ((-8, -3, -8, -2), 5.0)]


@pytest.mark.parametrize(
    ("pixels", "spacing", "speckle"), [(50, 0.48, False), (65, 0.48, False), (65, 0.48, True), (170, 0.141, True)]
)
def test_a_target_that_fills_the_scene_is_not_taken_for_ground(pixels: int, spacing: float, speckle: bool) -> None:
    """At 24 m, a half of the ground that is shown; the smallest pixels are averaged."""
    grid, views = ImageGrid(pixels, pixels, (spacing, spacing), (1.25 * spacing, 1.25 * spacing)), STEEP_TOO
    low, high = target_box(images(HOUSES, views, grid, speckle=speckle), views, grid)
    assert (low[:2] <= -9 + 0.3).all()
    assert (high[:2] >= 9 - 0.3).all()
    assert 5 <= high[2] < 14


def test_a_shadow_that_leaves_the_images_leaves_the_height_open() -> None:
    small = ImageGrid(56, 56, (0.2, 0.22), (0.3, 0.32))
    low, high = target_box(images(TANK[:2], TWENTY, small), TWENTY, small)
    assert 2.2 <= high[2] <= 0.65 * (high - low)[:2].min() + 4 * 0.32


def test_a_thin_part_that_hardly_stands_out_belongs_to_it() -> None:
    hull, barrel = (-3, 3, -1.5, 1.5), (3, 5, -0.15, 0.15)
    power = images([hull], ALL_AROUND, CHIP) + images([barrel], ALL_AROUND, CHIP, power=6.0)
    low, high = target_box(power, ALL_AROUND, CHIP)
    assert high[0] > 4.5
    assert low[0] > -4.5


def test_where_nothing_stands_out_it_is_the_middle_of_the_scene() -> None:
    low, high = target_box(images([], ALL_AROUND, CHIP), ALL_AROUND, CHIP)
    half = 120 * 0.22 / np.cos(np.radians(17)) / 2
    half = min(half, 100 * 0.2 / 2)
    assert (low.tolist(), high.tolist()) == ([-half / 2, -half / 2, 0], [half / 2, half / 2, 0.65 * half])


def test_images_that_are_black_or_hold_zeros_do_no_harm() -> None:
    power = images([SLAB], ALL_AROUND, CHIP)
    power[power < 0.3 * np.median(power)] = 0
    check(SLAB, *target_box(power, ALL_AROUND, CHIP), 0.31)
    assert np.isfinite(target_box(np.zeros_like(power), ALL_AROUND, CHIP)).all()


@pytest.mark.parametrize("center_m", [(100.0, 0.0), (0.0, -50.0)])
def test_images_beside_the_target_are_refused(center_m: tuple[float, float]) -> None:
    grid = ImageGrid(24, 24, (0.3, 0.3), (0.4, 0.4), center_m)
    with pytest.raises(SarsplatError, match="do not show the world's origin"):
        target_box(np.ones((2, 24, 24), np.float32), [View(0, 30), View(90, 30)], grid)
