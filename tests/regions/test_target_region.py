"""Where the target is looked for: what was given, else what images tell; and what is said of what lies beyond it."""

from dataclasses import replace

import numpy as np
import pytest

from sarsplat import Config, Dataset, DatasetEntry, ImageGrid, SarsplatError, SarsplatWarning, View, reconstruct
from sarsplat.gaussians.initialise import Region
from sarsplat.regions.target_region import cut_off, target_region

VIEWS = [View(azimuth, 40.0) for azimuth in range(0, 360, 45)]
GRID = ImageGrid(40, 40, (0.3, 0.3), (0.4, 0.4))


@pytest.fixture
def shown() -> Dataset:
    """Something bright in the middle, and something as bright at its edge, on the ground."""
    power = np.ones((len(VIEWS), 40, 40), np.float32)
    power[:, 17:23, 17:23] = 30
    for k, view in enumerate(VIEWS):
        along = 4.0 * np.cos(np.radians(view.azimuth_deg)), 4.0 * np.sin(np.radians(view.azimuth_deg))
        row, column = 20 - along[0] * np.cos(np.radians(40.0)) / 0.3, 20 - along[1] / 0.3
        power[k, round(row) - 2 : round(row) + 3, round(column) - 2 : round(column) + 3] = 30
    entries = tuple(DatasetEntry(view, "train", f"{k}") for k, view in enumerate(VIEWS))
    return Dataset(GRID, entries, power, target="two things", ground=True)


INNER = (-1.5, -1.5, 0.0, 1.5, 1.5, 1.0)
WHOLE = (-5.0, -5.0, 0.0, 5.0, 5.0, 1.0)


def test_a_box_of_the_settings_precedes_the_datasets_and_that_the_images(shown: Dataset) -> None:
    found = target_region(shown, ground=True)
    assert (found.high[:2] > 1).all()
    theirs = replace(shown, target_box_m=((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0)))
    for ground in (True, False):
        assert target_region(theirs, ground=ground).high.tolist() == [2, 2, 2]
        own = target_region(theirs, ground=ground, box=Config(target_box=INNER).box_m)
        assert (own.low.tolist(), own.high.tolist()) == ([-1.5, -1.5, 0], [1.5, 1.5, 1])


def test_what_stands_out_beyond_the_box_is_said(shown: Dataset) -> None:
    region = target_region(shown, ground=True, box=Config(target_box=INNER).box_m)
    (said,) = cut_off(region, 0.3, shown)
    assert "of the brightness above the ground lies outside of the box" in said
    assert "give another `target_box`" in said
    assert cut_off(target_region(shown, ground=True, box=Config(target_box=WHOLE).box_m), 0.3, shown) == []


def test_every_object_is_in_the_box_and_what_stands_beside_a_given_one_is_said() -> None:
    grid, power = ImageGrid(64, 64, (0.3, 0.3), (0.4, 0.4)), np.ones((len(VIEWS), 64, 64), np.float32)
    for k, view in enumerate(VIEWS):
        along = 6.0 * np.cos(np.radians(view.azimuth_deg)), 6.0 * np.sin(np.radians(view.azimuth_deg))
        row, column = round(32 - along[0] * np.cos(np.radians(40.0)) / 0.3), round(32 - along[1] / 0.3)
        power[k, row - 1 : row + 2, column - 1 : column + 2] = 30
        power[k, 26:38, 26:38] = 100
    entries = tuple(DatasetEntry(view, "train", f"{k}") for k, view in enumerate(VIEWS))
    dataset = Dataset(grid, entries, power, target="two things", ground=True)
    (said,) = cut_off(Region.box((-3, -3, 0), (3, 3, 2)), 0.0, dataset)
    assert said.startswith("what stands at x 5")
    assert " is outside of the box it is looked for in (" in said
    around = tuple(float(word) for word in said.partition("target_box=(")[2].partition(")")[0].split(", "))
    assert around[3] > 6
    assert cut_off(target_region(dataset, ground=True, box=Config(target_box=around).box_m), 0.0, dataset) == []
    assert target_region(dataset, ground=True).high[0] > 6
    power[:, 26:38, 26:38] = 1e5  # beside which it may be a response of glints
    assert cut_off(target_region(dataset, ground=True), 0.0, dataset) == []


def test_speckled_ground_alone_says_nothing() -> None:
    power = np.random.default_rng(0).exponential(size=(len(VIEWS), 40, 40)).astype(np.float32)
    power[:, 17:23, 17:23] *= 30
    entries = tuple(DatasetEntry(view, "train", f"{k}") for k, view in enumerate(VIEWS))
    dataset = Dataset(GRID, entries, power, target="one thing", ground=True)
    assert cut_off(target_region(dataset, ground=True), 0.3, dataset) == []


def test_gaussians_stay_in_the_given_box_and_a_run_keeps_it(shown: Dataset) -> None:
    config = Config(target_box=INNER, iterations=3, gaussians=50)
    with pytest.warns(SarsplatWarning, match="brightness above the ground"):
        run = reconstruct(shown, config, quiet=True)
    reach = 1.5 + config.margin * GRID.cell_m
    assert float(run.gaussians.means[:, :2].abs().max()) <= reach + 1e-6


def test_a_box_upside_down_is_refused() -> None:
    with pytest.raises(SarsplatError, match=r"target_box is .*lower corner"):
        Config(target_box=(1.0, -1.0, 0.0, -1.0, 1.0, 2.0))
