"""Clouds in parts."""

import numpy as np
import pytest
import torch

from sarsplat import Gaussians, ImageGrid, View
from sarsplat.scenes import surface_gaussians
from sarsplat.scenes.village import village
from sarsplat.surface import cells
from sarsplat.surface.cells import by_cubes, parts_of
from sarsplat.surface.neighbours import spacing_m
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.visibility import Seen


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
