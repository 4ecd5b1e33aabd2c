"""The procedural T-72 has a T-72's dimensions and is made of sound bodies."""

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.scenes import vehicle

pytest.importorskip("trimesh")


@pytest.fixture(scope="module")
def t72():
    return vehicle("t72")


def test_overall_dimensions(t72):
    low, high = t72.bounds
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    assert high[2] == pytest.approx(2.2, abs=0.01)
    assert (low[1], high[1]) == pytest.approx((-1.8, 1.8), abs=0.01)
    assert high[0] - low[0] == pytest.approx(9.55, abs=0.1)
    below_gun = t72.vertices[t72.vertices[:, 2] < 1.3]  # hull alone: neither gun nor drums
    assert below_gun[:, 0].max() == pytest.approx(3.45, abs=0.01)
    assert below_gun[:, 0].min() == pytest.approx(-3.45, abs=0.06)  # the unditching log stands out a little


def test_barrel_rises_forwards(t72):
    ahead = t72.vertices[t72.vertices[:, 0] > 4.0]
    assert np.abs(ahead[:, 1]).max() < 0.15
    root, tip = ahead[ahead[:, 0] < 4.5, 2], ahead[ahead[:, 0] > 5.8, 2]
    slope = (tip.mean() - root.mean()) / (5.95 - 4.2)
    assert 1.0 < np.degrees(np.arctan(slope)) < 5.0


def test_bodies_are_closed_and_face_outwards(t72):
    assert t72.is_watertight and t72.is_winding_consistent
    volumes = [body.volume for body in t72.split(only_watertight=False)]
    assert len(volumes) > 40
    assert min(volumes) > 0


def test_running_gear_is_the_same_on_both_sides(t72):
    gear = t72.vertices[t72.vertices[:, 2] < 0.46]
    left, right = gear[gear[:, 1] > 1.16], gear[gear[:, 1] < -1.16]
    assert len(left) == len(right) > 100
    assert np.sort(left[:, 0]) == pytest.approx(np.sort(right[:, 0]))


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(SarsplatError, match=r"'t73'.*t72"):
        vehicle("t73")
