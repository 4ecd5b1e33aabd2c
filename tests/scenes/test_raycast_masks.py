"""Masks by ray casting against the closed form of a box on the ground."""

import math

import numpy as np
import pytest

from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, View, radar_frame
from sarsplat.scenes.raycast import raycast_mask, raycast_masks

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRIDS = [
    ImageGrid(48, 40, (0.3, 0.3), (0.3, 0.3)),
    ImageGrid(90, 64, (0.25, 0.12), (0.5, 0.2), center_m=(0.4, -0.3)),
    ImageGrid(30, 100, (0.1, 0.4), (0.3, 0.4)),
]
LOW, HIGH = np.array([-2.1, -1.3, 0.0]), np.array([2.4, 1.2, 1.6])


def box(low: np.ndarray = LOW, high: np.ndarray = HIGH) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which points lie in the convex hull of corners, both in the imaging plane."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    return (points @ hull.equations[:, :2].T <= -hull.equations[:, 2]).all(axis=1)


def shares(view: View, grid: ImageGrid) -> np.ndarray:
    """For every pixel: the share covered by lit faces of the box, their area, and the share of its ground in shadow.

    The area is across the line of sight, in units of that of open ground.
    """
    finer = 8
    azimuth_axis, elevation_axis, range_axis = radar_frame(view)
    within = (np.arange(finer) + 0.5) / finer - 0.5
    azimuth = (grid.azimuth_m[:, None] + within * grid.spacing_m[0]).ravel()
    slant_range = (grid.range_m[:, None] + within * grid.spacing_m[1]).ravel()
    points = np.stack(np.meshgrid(azimuth, slant_range), axis=-1).reshape(-1, 2)
    upper = np.array([(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)], dtype=bool)
    corners = np.where(upper, HIGH, LOW)
    plane = np.column_stack([azimuth_axis, range_axis])
    faces = np.array([inside(corners[upper[:, k] == (range_axis[k] < 0)] @ plane, points) for k in range(3)])
    area = np.abs(range_axis / elevation_axis) / math.tan(math.radians(view.grazing_deg)) @ faces
    on_ground = corners - np.outer(corners[:, 2] / range_axis[2], range_axis)
    hidden = inside(on_ground @ plane, points)
    every = np.stack([faces.any(axis=0), area, hidden]).reshape(3, grid.rows, finer, grid.columns, finer)
    return every.mean(axis=(2, 4))


@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: str(grid.spacing_m))
@pytest.mark.parametrize("view", [View(25, 17), View(250, 45), View(101, 65)], ids=str)
def test_masks_of_a_box_are_those_of_its_outlines(view, grid):
    mask = raycast_mask(box(), view, grid)
    covered, area, hidden = shares(view, grid)
    true = np.where((covered >= 0.5) | (area >= 0.5), TARGET, np.where(hidden >= 0.5, SHADOW, CLUTTER))
    assert (true == SHADOW).sum() > 50
    clear = (covered > 0.8) | (covered < 0.02) & (np.abs(hidden - 0.5) > 0.25)
    np.testing.assert_array_equal(mask[clear], true[clear])
    assert (mask != true).sum() < 0.05 * (true != CLUTTER).sum()


@pytest.mark.parametrize("grazing", [5.0, 15.0, 45.0, 85.0])
def test_surfaces_have_no_holes(grazing):
    """Rays lie far apart in range on a roof seen at a low angle, and on a wall seen from above."""
    grid = ImageGrid(16, 8, (0.3, 0.3), (0.3, 0.3))
    plate = box(np.array([-32.0, -32, -1]), np.array([32.0, 32, 0]))
    wall = box(np.array([-1.0, -4, 0]), np.array([0.0, 4, 60]))
    assert (raycast_mask(plate, View(30, grazing), grid) == TARGET).all()
    assert (raycast_mask(wall, View(0, grazing), grid)[:8] == TARGET).all()


@pytest.mark.parametrize("grazing", [15.0, 60.0])
def test_a_surface_that_faces_the_radar_is_target(grazing):
    """It covers no area of the image plane, but returns more than any other."""
    upwards = radar_frame(View(0, grazing))[1]
    corners = np.array([(0, y, 0) + length * upwards for y in (-3, 3) for length in (0.0, 3.0)])
    plate = trimesh.Trimesh(corners, [(0, 1, 2), (2, 1, 3)], process=False)
    grid = ImageGrid(41, 41, (0.3, 0.3), (0.3, 0.3))
    lit = raycast_mask(plate, View(0, grazing), grid) == TARGET
    assert lit.any(axis=1).sum() == 1
    assert lit.any(axis=0).sum() in (20, 21)


def test_neither_brightness_nor_orientation_nor_resolution_matters():
    inverted = box()
    inverted.invert()
    blurred = ImageGrid(48, 40, (0.3, 0.3), (0.9, 0.6))
    true = raycast_mask(box(), View(25, 30), GRIDS[0])
    np.testing.assert_array_equal(raycast_mask(inverted, View(25, 30), blurred), true)


def test_nothing_below_the_ground_is_seen():
    views, counts = [View(25, 17), View(250, 45)], list[int]()
    masks = raycast_masks(box(LOW - (0, 0, 3), HIGH), views, GRIDS[0], progress=counts.append)
    np.testing.assert_array_equal(masks, [raycast_mask(box(), view, GRIDS[0]) for view in views])
    assert counts == [1, 2]
    assert not raycast_mask(box(LOW - (0, 0, 5), HIGH - (0, 0, 5)), View(25, 30), GRIDS[0]).any()
