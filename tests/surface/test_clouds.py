"""Clouds of points: which clusters are objects, which layer is seen from above, and clouds in parts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat import Gaussians, ImageGrid, View
from sarsplat.scenes import surface_gaussians, village
from sarsplat.surface import cells
from sarsplat.surface.cells import by_cubes, parts_of
from sarsplat.surface.clusters import bright, brightest_speckle_m2, largest
from sarsplat.surface.from_above import uppermost, without_holes
from sarsplat.surface.neighbours import spacing_m
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.visibility import Seen

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
    none = np.empty((0, 3))
    assert bright(none, high[:0], 0.3, np.ones(0), none, [], print).shape == largest(none, 0.3, 10).shape == (0,)


def test_the_brightest_speckle_grows_with_the_ground_the_grazing_angle_and_the_number_of_cells() -> None:
    level, steep = brightest_speckle_m2(0.05, [View(0, 45), View(0, 60)], GRID)
    assert level == pytest.approx(0.05 * 0.3**2 * (np.log(GRID.independent_samples) + np.euler_gamma))
    assert steep == pytest.approx(3**0.5 * level)
    assert brightest_speckle_m2(0.05, [View(0, 45)], replace(GRID, rows=2 * GRID.rows)) > level


# ---- seen from above: which layer counts, and by what weight ---------------------------------------------------------
@pytest.mark.parametrize(
    ("heights", "upward", "values", "expected"),
    [
        ([*np.arange(0, 5, 0.1), 5.0, 5.2], [0.05] * 50 + [0.9] * 2, None, 5.1),  # a roof, not the wall below it
        ([0.0, 0.1, 3.0, 3.1], [1, 1, 1, 1], None, 3.05),  # what is below a gap is not seen
        ([0.0, 0.4, 0.8], [1, 1, 1], None, 0.4),  # a slope without a gap
        ([1.0, 1.3], [1.0, 0.5], None, 1.1),  # by the area seen from above
        ([1.0, 1.2], [0.0, -0.1], None, 1.1),  # of walls alone by number
        ([0.0, 2.0], [1.0, 1.0], np.array([8.0, 3.0]), 3.0),  # another value of the uppermost
    ],
)
def test_the_mean_of_a_pixels_uppermost_layer(heights, upward, values, expected) -> None:
    pixel = np.zeros((len(heights), 2), np.int64)
    assert uppermost(pixel, (1, 1), np.array(heights), np.array(upward), values, 0.5).item() == pytest.approx(expected)


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


# ---- clouds in parts -------------------------------------------------------------------------------------------------
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


def test_normals_and_brightness_of_parts_are_those_of_the_whole() -> None:
    """Bit for bit, but where the nearest pieces of surface are not all within three resolution cells."""
    pytest.importorskip("trimesh")
    gaussians: Gaussians = surface_gaussians(village(38.0, edge_m=4.0), 1.0)[0]
    grid = ImageGrid(128, 128, (0.3, 0.3), (0.3, 0.3))
    seen = Seen.of(gaussians, [View(20.0, 40.0), View(200.0, 40.0)], grid)
    chance = np.random.default_rng(0)
    near = gaussians.means.numpy()[chance.integers(0, len(gaussians), 30_000)]
    points = (near + chance.normal(0, 0.1, near.shape)).astype(np.float32)
    gamma0, towards = seen.around(points)
    expected = surface_normals(points, towards, gaussians, grid.cell_m)
    assert np.linalg.norm(expected, axis=1) == pytest.approx(1)
    parts = list(parts_of(points, 3 * grid.cell_m, 5000))
    assert len(parts) > 6
    for some, own in parts:
        found, there = seen.around(points[some])
        normals = surface_normals(points[some], there, gaussians, grid.cell_m, spacing_m(points))
        assert (normals[own] == expected[some[own]]).all(1).mean() > 0.999
        np.testing.assert_allclose(normals[own], expected[some[own]], atol=1e-6)
        assert found.tobytes() == gamma0[some].tobytes()


def test_places_of_a_cube_have_its_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "_AT_ONCE", 100)
    places = torch.from_numpy(np.random.default_rng(0).uniform(-3, 3, (1000, 3)))
    found = list(by_cubes(places, 1.5))
    assert torch.cat([rows for rows, _, _ in found]).sort().values.tolist() == list(range(1000))
    for rows, middles, cube in found:
        assert len(rows) == 100
        assert (places[rows] - middles[cube]).abs().max() <= 0.75
        assert len(middles) < 40
    assert [len(rows) for rows, _, _ in by_cubes(places[:0], 1.5)] == [0]
