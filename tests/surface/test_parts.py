"""Clouds in parts."""

import numpy as np
import pytest

from sarsplat.surface.parts import parts_of


@pytest.mark.parametrize("kind", ["even", "a plane", "half a wall", "one place"])
def test_each_point_is_in_one_part_with_all_that_is_near_it(kind: str) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32) * [9, 5, 2]
    if kind == "a plane":
        points[:, 2] = 0.25
    elif kind == "half a wall":
        points[:1200, 0] = -20
    elif kind == "one place":
        points[:] = points[0]
    parts, reach = list(parts_of(points, 0.5, 300)), 0.5
    assert sorted(np.concatenate([some[own] for some, own in parts])) == list(range(2000))
    assert (len(parts) > 6) == (kind != "one place")
    for some, own in parts:
        assert kind == "one place" or own.sum() <= 300
        assert (np.diff(some) > 0).all()
        apart = np.linalg.norm(points[:, None] - points[some[own]][None, ::7], axis=2).min(1)
        assert set(np.flatnonzero(apart <= reach)) <= set(some)
    (everything,) = parts_of(points, 0.5, 2000)
    assert everything[0].tolist() == list(range(2000))
    assert everything[1].all()
    assert [len(some) for some, _ in parts_of(points[:0], 0.5)] == [0]
