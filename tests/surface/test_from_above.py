"""Points seen from above: which layer counts, and by what weight."""

import numpy as np
import pytest

from sarsplat.surface.from_above import uppermost, without_holes

ONE = np.zeros((1, 2), np.int64)


def mean_of(heights: list[float], upward: list[float], values: list[float] | None = None, gap: float = 0.5) -> float:
    pixel = np.repeat(ONE, len(heights), axis=0)
    return float(uppermost(pixel, (1, 1), np.array(heights), np.array(upward), values and np.array(values), gap)[0, 0])


def test_a_roof_counts_and_the_wall_below_it_does_not() -> None:
    wall = list(np.arange(0, 5, 0.1))
    assert mean_of([*wall, 5.0, 5.2], [0.05] * len(wall) + [0.9, 0.9]) == pytest.approx(5.1)


def test_what_is_below_a_gap_is_not_seen() -> None:
    assert mean_of([0.0, 0.1, 3.0, 3.1], [1, 1, 1, 1]) == pytest.approx(3.05)
    assert mean_of([0.0, 0.4, 0.8], [1, 1, 1]) == pytest.approx(0.4)  # a slope without a gap


def test_means_are_by_the_area_seen_from_above_and_of_walls_alone_by_number() -> None:
    assert mean_of([1.0, 1.3], [1.0, 0.5]) == pytest.approx(1.1)
    assert mean_of([1.0, 1.2], [0.0, -0.1]) == pytest.approx(1.1)
    assert mean_of([0.0, 2.0], [1.0, 1.0], [8.0, 3.0]) == 3.0  # another value of the uppermost


def test_points_outside_do_not_count_and_pixels_without_any_have_no_data() -> None:
    pixel = np.array([[0, 0], [1, 2], [5, 0], [-1, 1], [0, 3]])
    found = uppermost(pixel, (2, 3), np.arange(5.0), np.ones(5), None, 1.0)
    np.testing.assert_array_equal(found, [[0, np.nan, np.nan], [np.nan, np.nan, 1]])


def test_holes_between_pixels_are_closed_and_outlines_stay() -> None:
    values = np.full((20, 30), np.nan)
    values[5:15, 5:20] = 4.0
    values[8, 9:11] = np.nan  # a hole two pixels wide
    courtyard = values.copy()
    courtyard[7:13, 12:18] = np.nan  # and one of six
    filled = without_holes(courtyard, 1.5)
    assert (filled[8, 9:11] == 4.0).all()
    assert np.isnan(filled[8:12, 13:17]).all()
    assert np.isfinite(filled).sum() <= np.isfinite(values).sum() + 2
    edge = np.full((6, 6), np.nan)
    edge[:, 0] = 1.0
    np.testing.assert_array_equal(without_holes(edge, 3.0), edge)
