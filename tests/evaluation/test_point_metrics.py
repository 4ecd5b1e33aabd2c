"""Scores of points against a known surface: alignment, distances, and objects that points lack."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from made import FEW_POINTS, dataset_of, upright
from sarsplat import ImageGrid, Run, SarsplatError, View, render
from sarsplat.evaluation import Yardstick, all_metrics, metrics_of_points, point_metrics, visible_surface
from sarsplat.evaluation.left_open import _middles, missing
from sarsplat.evaluation.points import Alignment, align, first_of_voxels, on_surface
from sarsplat.runs.run_folder import left_open

trimesh = pytest.importorskip("trimesh")

YARDSTICK = Yardstick(0.3)
SQUARE = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], dtype=float)


def lattice(n: int, z: float = 0.0) -> np.ndarray:
    """Points, n × n, in the middle of equal cells of the unit square."""
    middle = (np.arange(n) + 0.5) / n
    x, y = np.meshgrid(middle, middle)
    return np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1)


def brute_force(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    every = np.repeat(points, len(triangles), axis=0)
    nearest = trimesh.triangles.closest_point(np.tile(triangles, (len(points), 1, 1)), every)
    return np.linalg.norm(nearest - every, axis=1).reshape(len(points), -1).min(axis=1)


def test_a_plane_raised_by_a_known_height():
    height = 0.15
    scores = point_metrics(lattice(20, height), SQUARE, lattice(20), YARDSTICK)
    assert scores.count == 400
    assert (scores.accuracy_m, scores.completeness_m, scores.cd_m) == pytest.approx((height, height, height))
    assert scores.cd_squared_m2 == pytest.approx(height**2)
    assert scores.f1 == {0.3: 1.0, 0.2: 1.0, 0.1: 0.0}


def test_normals_are_compared_with_the_nearest_triangle_whatever_their_signs() -> None:
    wall = np.array([[[5, 0, 0], [5, 1, 0], [5, 0, 1]]], dtype=float)
    points = np.concatenate([lattice(10), [[5, 0.2, 0.2]]])
    angle = np.radians(np.append(np.repeat([0, 10, 50], [40, 30, 30]), 0))
    normals = np.column_stack([np.sin(angle), np.zeros(101), np.cos(angle)])
    normals[::2] *= -1
    normals[-1] = [1, 0, 0]
    surface = np.concatenate([SQUARE, wall])
    scores = point_metrics(points, surface, lattice(10), YARDSTICK, normals)
    assert scores.normals_deg == pytest.approx(10)
    assert scores.normals_off == pytest.approx(30 / 101)
    twice = point_metrics(np.repeat(points, 2, axis=0), surface, lattice(10), YARDSTICK, np.repeat(normals, 2, axis=0))
    assert twice == scores
    without = point_metrics(points, surface, lattice(10), YARDSTICK)
    assert (without.normals_deg, without.normals_off) == (None, None)
    longer = point_metrics(points, surface, lattice(10), YARDSTICK, 3 * normals)
    assert longer.normals_deg == pytest.approx(10) and longer.normals_off == scores.normals_off


def test_half_the_surface_and_a_floater():
    # 128 points on the half x < 0.5, one floater 1 m above
    half = lattice(16)[lattice(16)[:, 0] < 0.5]
    points = np.concatenate([half, [[0.25, 0.25, 1.0]]])
    scores = point_metrics(points, SQUARE, lattice(16), YARDSTICK)
    assert scores.accuracy_m == pytest.approx(1 / 129)
    assert scores.precision[0.3] == pytest.approx(128 / 129)
    gaps = np.arange(1, 9) / 16  # of the columns right of the half
    assert scores.completeness_m == pytest.approx(gaps.sum() / 16)
    recall = 11 / 16
    assert scores.recall[0.2] == pytest.approx(recall)
    assert scores.f1[0.2] == pytest.approx(2 * (128 / 129) * recall / (128 / 129 + recall))
    assert scores.cd_m == pytest.approx((scores.accuracy_m + scores.completeness_m) / 2)
    assert scores.cd_squared_m2 == pytest.approx((1 / 129 + (gaps**2).sum() / 16) / 2)


def test_accuracy_is_measured_to_triangles_not_to_samples():
    scores = point_metrics(lattice(7), SQUARE, lattice(2), YARDSTICK)
    assert scores.accuracy_m < 1e-12
    assert scores.completeness_m > 0.01


def test_distance_is_exact_for_any_triangles():
    generator = np.random.default_rng(0)
    slivers = generator.normal(size=(20, 1, 3)) * 3 + generator.normal(size=(20, 3, 3)) * [4, 0.01, 0.3]
    small = generator.normal(size=(300, 1, 3)) * 2 + generator.normal(size=(300, 3, 3)) * 0.05
    triangles = np.concatenate([slivers, small, [[[-9, -9, -4], [9, -9, -4], [0, 9, -4]]]])
    points = generator.normal(size=(300, 3)) * 3
    points[:20] = triangles[:20].mean(axis=1)
    sphere = np.asarray(trimesh.creation.icosphere(subdivisions=2).triangles)
    middle = np.array([[1e-3, 0, 0]])  # where all triangles compete
    for places, surface in ((points, triangles), (middle, sphere)):
        assert on_surface(places, surface)[0] == pytest.approx(brute_force(places, surface), abs=1e-12)


@pytest.mark.parametrize("count", [1, 2, 5000])
@pytest.mark.parametrize("middle_m", [0.0, 40_000.0])
def test_samples_near_and_far_find_the_nearest_point(count: int, middle_m: float) -> None:
    generator = np.random.default_rng(count)
    points = generator.normal(size=(count, 3)) * [6, 2, 0.01] + middle_m
    samples = np.concatenate([points[:3000] + 0.01, generator.normal(size=(3000, 3)) * 30 + middle_m])
    nearest = cKDTree(points[first_of_voxels(points, YARDSTICK.voxel_m)]).query(samples)[0]
    scores = point_metrics(points, SQUARE + middle_m, samples, YARDSTICK)
    assert scores.completeness_m == pytest.approx(nearest.mean(), rel=1e-7)
    assert scores.recall[0.3] == np.mean(nearest <= 0.3)


def test_triangles_without_area_are_ignored():
    spike = np.array([[[5, 5, 5], [5, 5, 5], [6, 5, 5]]], dtype=float)
    assert on_surface(np.array([[0.5, 0.5, 2.0]]), np.concatenate([SQUARE, spike]))[0] == pytest.approx(2.0)


def test_one_point_per_voxel_is_kept_the_first():
    points = np.array([[0.011, 0, 0], [-0.001, 0, 0], [0.001, 0, 0], [0.019, 0.019, 0.019], [0.021, 0, 0]])
    assert first_of_voxels(points, 0.02).tolist() == [0, 1, 4]
    crowded = np.repeat(lattice(10), 5, axis=0)
    assert point_metrics(crowded, SQUARE, lattice(5), YARDSTICK).count == 100


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"points": np.empty((0, 3))}, "reconstructed points have shape .* at least one point"),
        ({"points": np.zeros((4, 2))}, "reconstructed points have shape .* at least one point"),
        ({"points": np.array([[0, 0, np.inf]])}, "reconstructed points hold values that are not finite"),
        ({"samples": np.empty((0, 3))}, "samples of the true surface have shape"),
        ({"samples": np.full((2, 3), np.inf)}, "samples of the true surface hold values that are not finite"),
        ({"normals": np.ones((3, 3))}, "9 points have 3 normals"),
        ({"normals": np.full((9, 3), np.nan)}, "normals of the points hold values that are not finite"),
        ({"triangles": np.zeros((1, 3, 3))}, "no triangle"),
    ],
)
def test_no_or_bad_points_samples_normals_and_triangles_are_refused(changed, message):
    usual = {"points": lattice(3), "triangles": SQUARE, "samples": lattice(5), "yardstick": YARDSTICK}
    with pytest.raises(SarsplatError, match=message):
        point_metrics(**usual | changed)


def grid(cell: float) -> ImageGrid:
    return ImageGrid(8, 8, (0.6 * cell, cell), (cell, 0.7 * cell))


@pytest.mark.parametrize(
    ("cell", "thresholds"),
    [
        (0.3, (0.3, 0.2, 0.1)),
        (0.312, (0.3, 0.2, 0.1)),  # MSTAR
        (3.0, (3.0, 2.0, 1.0)),
        (0.02, (0.02, 0.01, 0.007)),
        (0.148, (0.1, 0.07, 0.03)),
        (1e-5, (1e-5, 7e-6, 3e-6)),
    ],
)
def test_thresholds_follow_the_resolution_cell_to_one_digit(cell: float, thresholds: tuple[float, ...]) -> None:
    yardstick = Yardstick.of(grid(cell))
    assert yardstick.thresholds_m == thresholds
    assert yardstick.voxel_m == pytest.approx(thresholds[0] / 15)
    keys = [metric.key for metric in all_metrics(yardstick)]
    assert [f"f1@{threshold:g}" for threshold in thresholds] == [key for key in keys if key.startswith("f1@")]
    assert f"recall@{thresholds[0]:g}" in keys
    for size in range(10, 100):
        high, middle, low = Yardstick.of(grid(size / 1000)).thresholds_m
        assert high > middle > low > 0


@pytest.mark.parametrize("factor", [10.0, 1 / 15])
def test_a_larger_scene_has_the_same_scores_in_cells(factor: float) -> None:
    points = np.random.default_rng(2).normal(size=(500, 3)) * 0.02 + lattice(25)[:500]

    def scored(factor: float) -> list[float]:
        yardstick = Yardstick.of(grid(0.3 * factor))
        box = trimesh.creation.box((2 * factor, factor, factor))
        seen = visible_surface(box, [View(0, 45), View(90, 30)], yardstick.ray_spacing_m, samples=5000)
        up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        scored = point_metrics(points * factor, seen.triangles, seen.samples, yardstick, up)
        of_all = {metric.key: metric.compute(scored) for metric in metrics_of_points(yardstick)}
        cell = f"@{yardstick.cell_m:g}"
        lengths = [of_all[key] / factor for key in ("cd_m", "accuracy_m", "completeness_m")]
        angles = [of_all["normals_deg"], of_all["normals_off@30"]]
        return [*lengths, *angles, of_all["cd_squared_m2"] / factor**2, of_all[f"f1{cell}"], of_all["count"]]

    assert scored(factor) == pytest.approx(scored(1.0), rel=1e-3)


# ---- points brought onto a known surface by a small rigid motion -----------------------------------------------------
def surface(seed: int, count: int = 600) -> np.ndarray:
    """Samples of a stepped block without symmetry."""
    parts = [trimesh.creation.box(bounds=[[-1.2, -1.4, 0], [1.2, 1.4, 0.5]])]
    parts += [trimesh.creation.box(bounds=[[-1.0, 0.1, 0.5], [0.3, 1.2, 1.5]])]
    return trimesh.sample.sample_surface(trimesh.util.concatenate(parts), count, seed=seed)[0]


@pytest.mark.parametrize(("shift", "heading"), [((0, 0, 0), 0), ((0.5, -0.4, 0.1), 3), ((-0.7, 0.2, -0.2), -4)])
def test_it_undoes_a_motion(shift: tuple[float, float, float], heading: float) -> None:
    truth = Alignment(shift, heading, 0.9)
    moved = surface(0) - np.array(shift)
    turned = Alignment((0, 0, 0), -heading, 0.9).moved(moved)  # what `truth` brings back
    motion = align(turned + np.random.default_rng(0).normal(0, 0.03, turned.shape), surface(1), 0.3)
    np.testing.assert_allclose(motion.shift_m, truth.shift_m, atol=0.03)
    assert motion.heading_deg == pytest.approx(heading, abs=0.7)
    assert not motion.at_limit
    assert str(motion).startswith("moved by ")


def test_it_goes_no_farther_than_it_may() -> None:
    motion = align(surface(0) + np.array([2.0, 0, 0]), surface(1), 0.3)
    assert motion.shift_m[0] == pytest.approx(-0.9, abs=0.02)
    assert motion.at_limit
    assert [Alignment((0, 0, 0), turn, 0.9).at_limit for turn in (-5.0, 4.0)] == [True, False]


def test_strays_do_not_pull_and_a_shift_grows_with_the_cell() -> None:
    points = np.concatenate([surface(0), np.random.default_rng(0).uniform(3, 6, (600, 3))])
    for scale in (1, 10):
        motion = align(scale * (points + np.array([0.3, 0, 0])), scale * surface(1), 0.3 * scale)
        np.testing.assert_allclose(motion.shift_m, np.array([-0.3, 0, 0]) * scale, atol=0.03 * scale)


def test_what_is_aloft_is_turned_about_all_axes() -> None:
    for axis, name in enumerate("xyz"):
        about = Rotation.from_euler(name, 4.0, degrees=True).apply(surface(0))
        turns = np.zeros(3)
        turns[axis] = 4.0
        np.testing.assert_allclose(Alignment((0, 0, 0), turns[2], tilts_deg=tuple(turns[:2])).moved(surface(0)), about)
    turn = Rotation.from_rotvec([2.5, -3.0, 2.0], degrees=True)
    turned = turn.apply(surface(0)) + np.array([0.1, 0.2, -0.1])
    motion, level = (align(turned, surface(1), 0.3, aloft=aloft) for aloft in (True, False))
    assert level.tilts_deg == (0.0, 0.0)
    left = Rotation.from_euler("xyz", [*motion.tilts_deg, motion.heading_deg], degrees=True)
    assert np.degrees((left * turn).magnitude()) < 1.0
    assert "about x and y by" in str(motion) and "about x and y by" not in str(level)
    assert Alignment((0, 0, 0), 0.0, 0.9, (0.0, 5.0)).at_limit


# ---- objects that images show and points lack ------------------------------------------------------------------------
GRID = ImageGrid(64, 48, (0.25, 0.3), (0.25, 0.3))
VIEWS = [View(azimuth, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 40)]
BALLS = np.array([[-3.0, 0.0, 1.0], [3.0, 1.0, 2.0]])


def test_an_object_without_points_is_named_where_it_stands() -> None:
    gaussians = upright(BALLS, 0.4, 3.0, torch.tensor([[1.0], [0.5]]))
    images = render(gaussians, VIEWS, GRID).channel(0).numpy()
    speckled = images * np.random.default_rng(0).gamma(4.0, 0.25, images.shape).astype(np.float32)
    run = Run.from_gaussians(gaussians, dataset=dataset_of(GRID, [(view, "train") for view in VIEWS], speckled))
    run = replace(run, config=replace(run.config, points=FEW_POINTS))
    assert len(missing(run)) == 0
    vars(run)["points"] = run.points[run.points[:, 0] < 0]
    places = missing(run)
    assert len(places) == 1 and np.linalg.norm(places[0] - BALLS[1]) < 1.0
    assert "1 place" in left_open({"missing": places.tolist()})["missing"]


def test_patches_connected_at_half_the_level_are_one_object() -> None:
    excess_db = np.zeros((3, 9, 20))
    excess_db[1, 4, 2:9] = 2.0
    excess_db[1, 4, [2, 8]] = 4.0
    excess_db[1, 4, 14] = 5.0
    excess_db[1, 7, 14:18] = 2.5  # faint everywhere
    assert _middles(excess_db, 3.0).tolist() == [[1, 4, 14], [1, 4, 5]]
    assert _middles(excess_db, 6.0).shape == (0, 3)
