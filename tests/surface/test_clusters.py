"""Which clusters of points are objects."""

from dataclasses import replace

import numpy as np
import pytest

from sarsplat import ImageGrid, View
from sarsplat.surface.clusters import bright, brightest_speckle_m2, largest

GRID = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))


def blob(at: float, count: int = 60) -> np.ndarray:
    return np.random.default_rng(count).normal((at, 0, 1), 0.1, (count, 3))


def test_every_cluster_that_outshines_speckle_is_kept_and_others_are_named() -> None:
    near, far, faint = blob(0), blob(5), blob(9, 20)
    points, means = np.concatenate([near, far, faint]), np.array([[0.0, 0, 1], [5, 0, 1], [9, 0, 1], [20, 0, 1]])
    sections = np.array(
        [[3.0, 0.0, 0.1, 50.0]] * 3 + [[3.0, 2.0, 0.1, 50.0]], np.float32
    )  # m², one view lights the far one
    said: list[str] = []
    high = np.ones(len(points), bool)
    kept = bright(points, high, 0.3, np.ones(4), means, [sections[:2], sections[2:]], said.append)
    assert kept[:60].all() and not kept[120:].any()
    assert kept[60:120].mean() == pytest.approx(0.0)
    assert len(said) == 1 and "2 clusters" in said[0]
    assert bright(points, high, 0.3, np.ones(1), means, [sections[3:]], said.append)[:120].all()
    assert bright(points, high, 0.3, np.zeros(4), means, [sections], said.append).all()  # on a dark mirror
    assert not bright(points, ~high, 0.3, np.ones(4), means, [sections], said.append).any()


def test_the_brightest_speckle_grows_with_the_ground_the_grazing_angle_and_the_number_of_cells() -> None:
    level, steep = brightest_speckle_m2(0.05, [View(0, 45), View(0, 60)], GRID)
    assert level == pytest.approx(0.05 * 0.3**2 * (np.log(GRID.independent_samples) + np.euler_gamma))
    assert steep == pytest.approx(3**0.5 * level)
    assert brightest_speckle_m2(0.05, [View(0, 45)], replace(GRID, rows=2 * GRID.rows)) > level


def test_where_there_is_no_point_there_is_no_cluster() -> None:
    none = np.empty((0, 3))
    assert (
        largest(none, 0.3, 10).shape == bright(none, np.zeros(0, bool), 0.3, np.ones(0), none, [], print).shape == (0,)
    )
