"""The views and grids of the experiments."""

from collections import Counter

import pytest

from sarsplat.scenes import mstar_grid, mstar_views, paper_grid, paper_views


def test_paper_views_are_24_to_train_and_48_others():
    views = paper_views()
    assert Counter(split for _, split in views) == {"train": 24, "test": 48}
    assert len({view for view, _ in views}) == 72
    train = {view for view, split in views if split == "train"}
    assert {view.azimuth_deg for view in train} == {0, 45, 90, 135, 180, 225, 270, 315}
    assert Counter(view.grazing_deg for view, _ in views) == {75: 24, 45: 24, 15: 24}
    assert {view.incidence_deg for view in train} == {15, 45, 75}


def test_mstar_views_test_between_the_training_azimuths():
    views = mstar_views()
    assert Counter(split for _, split in views) == {"train": 36, "test-17": 36, "test-15": 36}
    grazing = {split: {view.grazing_deg for view, s in views if s == split} for _, split in views}
    assert grazing == {"train": {17}, "test-17": {17}, "test-15": {15}}
    train = {view.azimuth_deg for view, split in views if split == "train"}
    assert not train & {view.azimuth_deg for view, split in views if split != "train"}


def test_grids():
    assert (paper_grid().rows, paper_grid().columns) == (128, 128)
    assert paper_grid().spacing_m == paper_grid().resolution_m == (0.3, 0.3)
    assert mstar_grid().spacing_m == pytest.approx((0.203125, 0.202148))
    assert mstar_grid().resolution_m == pytest.approx((0.3229, 0.3013))
