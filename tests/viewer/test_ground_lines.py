"""Lines on the ground, and the image below it."""

import numpy as np
import pytest

from sarsplat.viewer.stage import ground_lines, seen_through

MIDDLE, REACH = np.array([1.0, -2.0, 0.0]), 6.0
TILTED = np.array([[-3.0, -4.0, 1.5], [4.0, -4.0, 1.5], [4.0, 4.0, -4.0], [-3.0, 4.0, -4.0]])  # through the ground


def in_the_picture(eye, place, corners):
    """Whether the ray from the eye through a place on the ground meets the picture behind that, well inside."""
    across, down = corners[1] - corners[0], corners[3] - corners[0]
    a, b, distance = np.linalg.solve(np.stack([across, down, eye - place], axis=1), eye - corners[0])
    return distance > 1.001 and 0.01 < a < 0.99 and 0.01 < b < 0.99


@pytest.mark.parametrize("eye", [(-9.0, -7.0, 6.0), (12.0, 3.0, 2.0), (0.0, 9.0, 14.0), (3.0, -12.0, -5.0)])
def test_no_line_crosses_the_picture_and_none_is_missing_beside_it(eye):
    eye = np.array(eye)
    lines = ground_lines(MIDDLE, REACH, 1.0, seen_through(TILTED, eye))
    every = ground_lines(MIDDLE, REACH, 1.0, np.empty((0, 2)))
    assert len(every) == 2 * 13
    shares = np.linspace(0, 1, 120)[:, None]
    places = np.concatenate([start + shares * (end - start) for start, end in every])
    hidden = np.array([in_the_picture(eye, place, TILTED) for place in places])
    assert 0 < hidden.sum() < len(places)
    drawn = np.concatenate([start + shares * (end - start) for start, end in lines])
    assert not any(in_the_picture(eye, place, TILTED) for place in drawn)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    assert length == pytest.approx((~hidden).mean() * 2 * 13 * 2 * REACH, rel=0.05)


def test_a_picture_above_the_ground_hides_no_line():
    assert len(seen_through(TILTED + np.array([0, 0, 5.0]), np.array([0.0, 9.0, 14.0]))) == 0
