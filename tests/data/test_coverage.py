"""Views by set and grazing angle, the widest gap between them, and training views evenly spread over what there is."""

import numpy as np
import pytest

from made import dataset_of
from sarsplat.data import Dataset
from sarsplat.data.coverage import even_azimuths, largest_gap, nearest_to, view_groups
from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes import mstar_views, paper_views
from sarsplat.scenes.protocols import random_views

GRID = ImageGrid(4, 4, (0.3, 0.3), (0.3, 0.3))


def dataset(views: list[tuple[View, str]]) -> Dataset:
    return dataset_of(GRID, views, np.ones((len(views), 4, 4), np.float32))


def test_the_largest_gap_is_named_clockwise():
    gap = largest_gap([350, 10, 40, -90])
    assert (gap.width_deg, gap.first_deg, gap.last_deg) == (230, 40, 270)
    assert str(gap) == "230°, from 40° clockwise to 270°"
    assert str(largest_gap([300, 20, 30])) == "270°, from 30° clockwise to 300°"
    assert largest_gap([5, 365, -355]).width_deg == 360  # one direction, three times


def test_groups_of_the_protocols():
    groups = view_groups(dataset(list(paper_views())))
    assert [(group.split, *group.grazing_deg, len(group.views), group.step_deg) for group in groups] == [
        *(("train", grazing, grazing, 8, 45) for grazing in (15, 45, 75)),
        *(("test", grazing, grazing, 16, 15) for grazing in (15, 45, 75)),
    ]
    assert groups[0].azimuths_deg == list(range(0, 360, 45))
    groups = view_groups(dataset(list(mstar_views())))
    counts = [(group.split, round(group.grazing_deg[0]), len(group.views)) for group in groups]
    assert counts == [("train", 17, 36), ("test-17", 17, 36), ("test-15", 15, 36)]


def test_measured_grazing_angles_belong_together_and_random_ones_too():
    scattered = [(View(10.0 * k, 17 + 0.2 * (k % 3)), "train") for k in range(36)]
    assert len(view_groups(dataset(scattered))) == 1
    drawn = [(view, "train") for view in random_views(24, 15, 75, 0)]
    (group,) = view_groups(dataset(drawn))
    assert group.grazing_deg[1] - group.grazing_deg[0] > 30


@pytest.mark.parametrize(("azimuths", "step"), [([30], None), ([350, 10, 30, 180], 20)])
def test_the_step_is_the_median_without_the_largest_gap(azimuths, step):
    views = [(View(azimuth, 45), split) for split in ("train", "test") for azimuth in azimuths]
    assert [group.step_deg for group in view_groups(dataset(views))] == [step, step]


PART = [10, 20, 35, 50, 70]


@pytest.mark.parametrize(
    ("azimuths", "expected"),
    [
        (range(0, 360, 10), [0, 90, 180, 270]),
        *((PART, expected) for expected in ([0], [10, 70], [10, 30, 50, 70])),
        ([330, 350, 10, 30], [330, 0, 30]),
    ],
)
def test_a_circle_is_shared_out_from_zero_and_a_part_from_end_to_end(azimuths, expected):
    assert [azimuth % 360 for azimuth in even_azimuths(azimuths, len(expected))] == expected


def test_the_nearest_are_distinct():
    assert nearest_to([5, 91, 179, 268, 275], [0, 90, 180, 270]) == [0, 1, 2, 3]
