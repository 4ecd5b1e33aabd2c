"""Which of the returns that rays have become points."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from made import upright
from sarsplat import Gaussians, ImageGrid, RayGrid, RayMap, SarsplatError, View, memory
from sarsplat.settings.sections import PointExtraction
from sarsplat.surface import bricks as of_bricks
from sarsplat.surface import cells as of_cells
from sarsplat.surface import extract_points
from sarsplat.surface import points as of_points
from sarsplat.surface.bricks import Brick, Scene, Window, ray_count
from sarsplat.surface.cells import Voxels
from sarsplat.surface.clusters import largest
from sarsplat.surface.first_returns import FirstReturnsOnCpu, OfView, traced
from sarsplat.surface.points import between, spread

GRID = ImageGrid(32, 32, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(45.0 * k, 30.0) for k in range(8)]
HEIGHT, RADIUS = 1.5, 1.2
KEPT = PointExtraction(rays_per_pixel=4.0, seen_through=0.25)


@pytest.fixture(scope="module")
def ball_with_a_hole() -> Gaussians:
    """An opaque shell; through a hole in it the first view alone sees what is at its centre."""
    outwards = pytest.importorskip("trimesh").creation.icosphere(subdivisions=4).vertices
    shell = RADIUS * outwards[outwards @ VIEWS[0].direction < np.cos(np.radians(15))]
    means = np.concatenate([shell, np.zeros((1, 3))])
    means[:, 2] += HEIGHT
    return upright(means, 0.05, 6.0)


def from_centre_m(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - [0, 0, HEIGHT], axis=1)


def test_what_one_view_alone_sees_is_left_out_if_others_must_see_it(ball_with_a_hole: Gaussians) -> None:
    all_points = extract_points(ball_with_a_hole, VIEWS, GRID, KEPT)
    assert from_centre_m(all_points).min() < 0.4
    points = extract_points(ball_with_a_hole, VIEWS, GRID, replace(KEPT, seen_by=3))
    assert len(points) > 0.8 * len(all_points)  # the shell, each part of which faces several views
    assert np.allclose(from_centre_m(points), RADIUS, atol=0.3)


def test_of_few_views_a_fifth_is_enough(ball_with_a_hole: Gaussians) -> None:
    views = VIEWS[::4]  # opposite ones, which see nothing in common
    usual = extract_points(ball_with_a_hole, views, GRID, KEPT)
    assert len(usual) > 0
    assert np.array_equal(extract_points(ball_with_a_hole, views, GRID, replace(KEPT, seen_by=3)), usual)


def test_views_between_neighbours_alone() -> None:
    ring = [View(azimuth, 30.0) for azimuth in (0.0, 90.0, 180.0, 270.0)]
    grazing = np.degrees(np.arctan(np.tan(np.radians(30)) / np.cos(np.radians(45))))
    actual = sorted((view.azimuth_deg, view.grazing_deg) for view in between([*ring, ring[0]]))
    assert actual == [pytest.approx((azimuth, grazing)) for azimuth in (45, 135, 225, 315)]  # opposite ones see others
    assert between(ring[:1]) == []


def test_how_far_behind_a_place_its_ray_returns() -> None:
    ranges = np.pad([[1.0, 2.0, np.inf], [4.0, 5.0, 6.0]], 1, constant_values=np.inf)  # two rows of y, three columns
    returns = OfView(np.eye(3), ranges, (19, 9), (0.5, 2.0))  # the first of them at (20.5, 10.5) steps
    beyond = {(10.25, 21): 1, (10.75, 21): 2, (11.25, 21): np.inf, (11.45, 23.9): 6, (10.45, 22.1): 4}
    beyond |= dict.fromkeys([(9.95, 21), (11.55, 21), (10.25, 19.9), (10.25, 24.1)], np.inf)
    places = np.array([(*place, 0.25) for place in beyond])
    assert returns.beyond(places).tolist() == [far - 0.25 for far in beyond.values()]
    x, y, r = returns.points().T
    assert [*zip(x, y, r)] == [(10.25, 21, 1), (10.75, 21, 2), (10.25, 23, 4), (10.75, 23, 5), (11.25, 23, 6)]


def test_points_are_those_that_enough_of_all_views_confirm(ball_with_a_hole: Gaussians) -> None:
    """By the definition, every point held against every view."""
    how = replace(KEPT, seen_by=3)
    rays = RayGrid.for_image(GRID, how.rays_per_pixel)
    views = [*VIEWS, *between(VIEWS)]
    found = traced(Scene(ball_with_a_hole, rays), None, views, GRID, rays, how.optical_depth, lambda count: None)
    returns = FirstReturnsOnCpu.of(found, rays).views
    every = np.concatenate([each.points() for each in returns])
    cells, owner = np.unique(np.floor(every / (how.voxel * GRID.cell_m)), axis=0, return_inverse=True)
    expected = np.stack([every[owner.ravel() == k].mean(axis=0) for k in range(len(cells))])
    beyond = np.stack([each.beyond(expected) for each in returns])
    through, seen = beyond > how.behind * GRID.cell_m, np.abs(beyond) <= how.behind * GRID.cell_m
    expected = expected[(through.mean(axis=0) <= how.seen_through) & (seen.sum(axis=0) >= 3)]
    assert 0 < len(expected) < len(cells)
    np.testing.assert_allclose(extract_points(ball_with_a_hole, VIEWS, GRID, how), expected, atol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e15])
def test_voxels_are_the_same_however_the_points_come(offset: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """All at once or in parts, and where cells are so many that no number counts them."""
    places = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    places[0] += offset
    once = Voxels(0.3)
    once.add(torch.from_numpy(places))
    monkeypatch.setattr(of_cells, "MOST_WAITING", 40)
    parts = Voxels(0.3)
    for part in np.array_split(places, 20):
        parts.add(torch.from_numpy(part))
    cells = np.unique(np.floor(places / 0.3), axis=0)
    assert len(once.means()) == len(cells)
    np.testing.assert_array_equal(np.floor(once.means().numpy() / 0.3), cells)
    np.testing.assert_allclose(parts.means(), once.means(), rtol=1e-12)
    assert Voxels(0.3).means().shape == (0, 3)


def test_many_views_are_thinned_evenly() -> None:
    ring = [View(float(azimuth), 30.0) for azimuth in range(360)]
    some = spread(ring, 12)
    assert len(some) == 12
    assert some[0] == ring[0]
    gaps = np.diff([view.azimuth_deg for view in some] + [360.0])
    assert gaps.max() <= 2 * gaps.min() + 1
    assert spread(ring, 360) == ring
    assert len(spread([ring[0]] * 9, 4)) <= 4


def test_large_scenes_are_traced_by_fewer_rays_and_still_are_on_the_surface(ball_with_a_hole: Gaussians, monkeypatch):
    """Down to a limit, which holds however large the scene."""
    usual = extract_points(ball_with_a_hole, VIEWS, GRID, KEPT)
    rays = ray_count(ball_with_a_hole, [*VIEWS, *between(VIEWS)], RayGrid.for_image(GRID, KEPT.rays_per_pixel))
    monkeypatch.setattr(of_points, "_MOST_RAYS", rays / 16)
    monkeypatch.setattr(spread, "__defaults__", (12,))
    many = [View(10.0 * k, 30.0) for k in range(36)]
    said: list[str] = []
    shown = of_points.stage
    monkeypatch.setattr(of_points, "stage", lambda words, total: said.append(words) or shown(words, total))
    points = extract_points(ball_with_a_hole, many, GRID, KEPT)
    assert re.fullmatch(r"surface: rays 2.7 times as far apart as set from 12 of \d+ views", said[0])
    assert len(usual) / 40 < len(points) < len(usual)
    assert np.median(np.abs(from_centre_m(points) - RADIUS)) < 0.2
    monkeypatch.setattr(of_points, "_MOST_RAYS", rays / 100)
    fewer = extract_points(ball_with_a_hole, many, GRID, KEPT)
    assert said[1] == said[0]
    assert sorted_rows(fewer).tobytes() == sorted_rows(points).tobytes()


def sorted_rows(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def test_bricks_change_no_bit(ball_with_a_hole: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    """Occluders outside a brick count, and haze that views look through from elsewhere."""
    twice = Gaussians.cat([ball_with_a_hole, upright(np.array([[2.5, -1, 0.7], [-2, 2, 3]]), 0.3, 0.5)])
    how = replace(KEPT, voxel=0.2, seen_by=2, min_height=1.0)
    whole = extract_points(twice, VIEWS, GRID, how)
    assert len(whole) > 1000
    cut: list[int] = []
    bricks_of = Scene.bricks

    def counting(*arguments: object) -> list[Brick]:
        bricks = list(bricks_of(*arguments))
        cut.append(len(bricks))
        return bricks

    monkeypatch.setattr(Scene, "bricks", counting)
    monkeypatch.setattr(of_points, "_COARSEST", 1e-3)
    monkeypatch.setattr(of_bricks, "_SMALLEST", 8)
    monkeypatch.setattr(of_points, "_MOST_RAYS", 15_000)
    assert sorted_rows(extract_points(twice, VIEWS, GRID, how)).tobytes() == sorted_rows(whole).tobytes()
    assert cut[0] > 4


def test_a_voxel_that_takes_too_many_rays_is_a_brick_anyway(ball_with_a_hole: Gaussians) -> None:
    rays = RayGrid.for_image(GRID, 10)
    bricks = [*Scene(ball_with_a_hole, rays).bricks(VIEWS, rays, 40 * rays.spacing_m[0], 1)]
    assert all(np.subtract(brick.end, brick.first).max() == 1 for brick in bricks)
    assert len(bricks) > 8


def test_rays_of_a_window_are_cut_from_what_was_traced() -> None:
    rays, ranges = RayGrid((0.5, 2.0)), torch.tensor([[1.0, 2.0, torch.nan], [4.0, 5.0, 6.0]])
    traced = RayMap(torch.ones(2, 3), ranges, (-0.25, 3.0))
    assert Window.of(traced, rays) == Window(-1, 1, 3, 2)
    inf = np.inf
    for window, expected in (
        (Window(-1, 1, 3, 2), [[1, 2, inf], [4, 5, 6]]),
        (Window(-2, 2, 4, 2), [[inf, 4, 5, 6], [inf] * 4]),
        (Window(0, 0, 1, 4), [[inf], [2], [5], [inf]]),
        (Window(7, 1, 2, 1), [[inf, inf]]),
        (Window(-9, -9, 1, 2), [[inf], [inf]]),
    ):
        assert window.cut(traced, rays).tolist() == expected
    around = Window.around(np.array([[-0.3, 2.9], [0.8, 3.2]]), rays)
    assert around == Window(-3, -1, 7, 5)


def test_what_does_not_fit_into_memory_is_refused(ball_with_a_hole: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_bytes", lambda: 1000.0)
    monkeypatch.setattr(of_points, "traced", lambda *_: pytest.fail("must not get here"))
    with pytest.raises(SarsplatError, match=r"^extracting the surface takes about .* 9\.3e-07 GiB are free"):
        extract_points(ball_with_a_hole, VIEWS, GRID, KEPT)


def test_the_largest_cluster_is_kept_however_dense_the_points() -> None:
    """A line with a gap wider than the radius; of the few at its side there are too few to be one."""
    rng = np.random.default_rng(0)
    for dense in (1, 20):
        long, short = rng.uniform(0, 10, (400 * dense, 3)), rng.uniform([11.5, 0, 0], [14.5, 3, 3], (300 * dense, 3))
        line, beside = np.concatenate([long, short]) * [1, 0.01, 0.01], np.array([[5.0, 3, 0], [5.0, 3.2, 0]])
        points = np.concatenate([line, beside])
        kept = points[largest(points, 0.8, 10)]
        np.testing.assert_array_equal(kept, line[: len(long)])
