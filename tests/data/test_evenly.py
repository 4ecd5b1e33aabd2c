"""Training views are spread over the azimuths that there are."""

from __future__ import annotations

import pytest

from sarsplat.data.coverage import even_azimuths, nearest_to


def test_a_whole_circle_is_shared_out_from_zero():
    assert even_azimuths(range(0, 360, 10), 4) == [0, 90, 180, 270]
    assert nearest_to([5, 91, 179, 268, 275], [0, 90, 180, 270]) == [0, 1, 2, 3]


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [10, 70]), (4, [10, 30, 50, 70])])
def test_a_part_of_it_is_shared_out_from_end_to_end(count, expected):
    assert even_azimuths([10, 20, 35, 50, 70], count) == expected


def test_a_part_across_zero():
    assert [azimuth % 360 for azimuth in even_azimuths([330, 350, 10, 30], 3)] == [330, 0, 30]
