"""What finds points and normals on a GPU, here on the CPU: the same as scipy's trees and numpy find there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from made import hill
from sarsplat import Gaussians, ImageGrid, Terrain, View, extract_points
from sarsplat.learning.strategies.growth import holding
from sarsplat.learning.strategies.ops import whole_sums
from sarsplat.scenes import surface_gaussians, target_mesh, village
from sarsplat.settings.sections import PointExtraction
from sarsplat.surface import cells, first_returns, neighbours, normals, points
from sarsplat.surface.mesh import surface_mesh
from sarsplat.surface.neighbours import Neighbours
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.visibility import Seen

RING = [View(azimuth, grazing) for azimuth in range(7, 360, 90) for grazing in (25.0, 50.0)]


class Scene(NamedTuple):
    gaussians: Gaussians
    grid: ImageGrid
    how: PointExtraction
    terrain: Terrain | None = None


class Found(NamedTuple):
    points: np.ndarray
    normals: np.ndarray
    gamma0: np.ndarray

    @classmethod
    def of(cls, scene: Scene, points: np.ndarray | None = None) -> Found:
        """Also at other points."""
        if points is None:
            points = extract_points(scene.gaussians, RING, scene.grid, scene.how, scene.terrain)
        gamma0, towards = Seen.of(scene.gaussians, RING, scene.grid).around(points)
        return cls(points, surface_normals(points, towards, scene.gaussians, scene.grid.cell_m), gamma0)


def with_haze(gaussians: Gaussians, count: int, reach_m: float) -> Gaussians:
    """Small opaque Gaussians all around, which others look past."""
    chance = np.random.default_rng(0)
    means = torch.tensor(chance.uniform([-reach_m, -reach_m, 0], [reach_m, reach_m, 6], (count, 3)))
    haze = gaussians[torch.arange(count) % len(gaussians)].with_tensors(means=means.float())
    tensors = {name: torch.cat([each, haze.tensors()[name]]) for name, each in gaussians.tensors().items()}
    return gaussians.with_tensors(**tensors)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    pytest.importorskip("trimesh")
    vehicle = surface_gaussians(target_mesh("t72"), 0.4)[0]
    houses = surface_gaussians(village(20.0, edge_m=4.0), 1.0)[0]
    grid, how = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3)), PointExtraction(rays_per_pixel=2.0, voxel=0.4)
    return {
        "vehicle": Scene(with_haze(vehicle, 300, 5.0), grid, how),
        "on a hill": Scene(vehicle, grid, how, hill()),
        "seen often": Scene(vehicle, grid, replace(how, seen_by=3)),
        "village": Scene(with_haze(houses, 200, 7.0), grid, PointExtraction(rays_per_pixel=1.0, voxel=1.0)),
    }


@pytest.fixture(scope="module")
def on_cpu(scenes: dict[str, Scene]) -> Callable[[str], Found]:
    """What the CPU finds in a scene, once."""
    return cache(lambda name: Found.of(scenes[name]))


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From then on, the CPU counts as another device."""
    return lambda: monkeypatch.setattr(cells, "on_cpu", lambda tensor: False)


@pytest.mark.parametrize("name", ["vehicle", "on a hill", "seen often", "village"])
def test_points_and_normals_are_those_of_the_cpu(name: str, scenes: dict[str, Scene], on_cpu: Any, elsewhere) -> None:
    """Up to ties at the edges of voxels."""
    scene, expected = scenes[name], on_cpu(name)
    elsewhere()
    actual, there = Found.of(scene), Found.of(scene, expected.points)
    assert len(expected.points) > 1000
    assert len(actual.points) == pytest.approx(len(expected.points), rel=5e-3)
    apart = np.concatenate([cKDTree(a.points).query(b.points)[0] for a, b in ((actual, expected), (expected, actual))])
    assert apart.mean() < 1e-3 * scene.grid.cell_m
    assert (apart < 0.1 * scene.grid.cell_m).mean() > 0.998
    cosine = np.einsum("pc,pc->p", there.normals, expected.normals)
    sine = np.linalg.norm(np.cross(there.normals, expected.normals), axis=1)
    assert ((sine < 1e-3) & (cosine > 0)).mean() > 0.99
    np.testing.assert_allclose(there.gamma0, expected.gamma0, rtol=1e-4, atol=1e-7)


def test_results_repeat_to_the_bit(scenes: dict[str, Scene], elsewhere: Any) -> None:
    elsewhere()
    for one, other in zip(Found.of(scenes["village"]), Found.of(scenes["village"]), strict=True):
        assert one.tobytes() == other.tobytes()


def test_parts_are_as_a_whole_on_the_cpu(scenes: dict[str, Scene], on_cpu: Any, elsewhere: Any, monkeypatch) -> None:
    """Many points, many rays, and bricks."""
    scene, expected = scenes["on a hill"], on_cpu("on a hill").points
    monkeypatch.setattr(cells, "MOST_WAITING", 5000)
    monkeypatch.setattr(points, "_COARSEST", 1e-3)
    monkeypatch.setattr(points, "_MOST_RAYS", 60_000)
    monkeypatch.setattr(first_returns, "_AT_ONCE", 20_000)
    elsewhere()
    actual = extract_points(scene.gaussians, RING, scene.grid, scene.how, scene.terrain)
    assert len(actual) == pytest.approx(len(expected), rel=5e-3)
    assert cKDTree(actual).query(expected)[0].mean() < 1e-3 * scene.grid.cell_m


def test_several_views_are_rendered_at_once_elsewhere(scenes: dict[str, Scene], elsewhere: Any) -> None:
    scene = scenes["vehicle"]
    rays = first_returns.RayGrid.for_image(scene.grid)
    asked = scene.gaussians, RING, scene.grid, rays
    assert [len(some) for some in first_returns.view_batches(*asked)] == [1] * len(RING)
    elsewhere()
    assert [len(some) for some in first_returns.view_batches(*asked)] == [len(RING)]
    assert [*first_returns.view_batches(scene.gaussians[:0], *asked[1:])] == [[view] for view in RING]


def test_strongest_centres_are_those_of_the_cpu(scenes: dict[str, Scene], elsewhere: Any) -> None:
    scene = scenes["vehicle"]._replace(how=PointExtraction(method="centres", power_share=0.9, voxel=0.2))
    expected = extract_points(scene.gaussians, RING, scene.grid, scene.how)
    elsewhere()
    assert len(expected) > 100
    np.testing.assert_array_equal(extract_points(scene.gaussians, RING, scene.grid, scene.how), expected)


def test_a_mesh_is_that_of_the_cpu(scenes: dict[str, Scene], on_cpu: Any, elsewhere: Any) -> None:
    pytest.importorskip("skimage")
    scene, found = scenes["seen often"], on_cpu("seen often")
    seen = Seen.of(scene.gaussians, RING, scene.grid)
    expected = surface_mesh(found.points, found.normals, seen, scene.grid.cell_m)
    elsewhere()
    actual = surface_mesh(found.points, found.normals, seen, scene.grid.cell_m)
    assert len(actual.faces) == pytest.approx(len(expected.faces), rel=5e-3)
    assert actual.area == pytest.approx(expected.area, rel=1e-3)
    assert cKDTree(actual.vertices).query(expected.vertices)[0].mean() < 1e-3 * scene.grid.cell_m
    single = surface_mesh(found.points[:1], found.normals[:1], seen, scene.grid.cell_m)
    assert len(single.faces) < 100


@pytest.mark.parametrize("kind", ["even", "clusters", "a line", "one place", "a few"])
def test_nearest_points_are_the_nearest(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "_PAIRS", 1000)
    chance = np.random.default_rng(0)
    points = chance.uniform(-1, 1, (600, 3))
    if kind == "clusters":
        points = points * 0.01 + chance.integers(0, 3, (600, 1)) * 10.0
    elif kind == "a line":
        points = points[:, :1] * [3.0, 0.0, 0.0]
    elif kind == "one place":
        points[:] = 5.0
    elif kind == "a few":
        points = points[:7]
    places = np.concatenate([points[::3], chance.uniform(-4, 4, (50, 3)), [[40.0, 0, 0], [-40.0, 3, 100]]])
    near = Neighbours(torch.tensor(points))
    for count in (1, 7):
        expected = cKDTree(points).query(places, k=range(1, count + 1))[0]
        squares, index = (found.numpy() for found in near.nearest(torch.tensor(places), count))
        np.testing.assert_allclose(np.sqrt(squares), expected, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(points[index] - places[:, None], axis=2), np.sqrt(squares))
        assert all(len(set(row)) == count for row in index.tolist())


def test_points_spread_least_along_the_axis_of_the_smallest_eigenvalue() -> None:
    """Of any size; of a line across it, and of a ball anywhere, both towards the radar."""
    chance = np.random.default_rng(0)
    turns = Rotation.random(300, rng=chance).as_matrix()
    upper = ..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]  # the six numbers of a symmetric matrix
    values = np.sort(chance.uniform(0, 1, (300, 3)), axis=1) * 10.0 ** chance.uniform(-12, 12, (300, 1))
    values[:50, 0] = 0.0
    values[50:100, 2] = values[50:100, 1]
    spread = np.einsum("nij,nj,nkj->nik", turns, values, turns)

    def axes(matrices: np.ndarray) -> np.ndarray:
        towards = torch.tensor([[0.0, 0.0, 1.0]]).double().repeat(len(matrices), 1)
        return normalize(normals._across(torch.tensor(matrices[upper]), towards), dim=1).numpy()

    assert np.linalg.norm(np.cross(axes(spread), turns[:, :, 0]), axis=1).max() < 1e-6
    line, ball, none = np.outer([3.0, 0, 4], [3.0, 0, 4]), np.eye(3), np.zeros((3, 3))
    np.testing.assert_allclose(axes(np.stack([line, ball, none])), [[-0.8, 0, 0.6], [0, 0, 1], [0, 0, 1]], atol=1e-6)


def test_sums_along_a_ranking_do_not_depend_on_the_order_of_additions() -> None:
    values = torch.rand(10_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) ** 20
    torch.testing.assert_close(whole_sums(values), values.cumsum(0), rtol=0, atol=1e-12 * float(values.sum()))
    assert not whole_sums(torch.zeros(5).double()).any()
    assert holding(values, 0.5).sum() > 0
