"""Where Gaussians start: the space that images bound, and the paper's hemisphere."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.initialise import Region, bounded_region, hemisphere_shell, random_quaternions
from sarsplat.geometry import ImageGrid, View, radar_frame

GRID = ImageGrid(64, 64, spacing_m=(0.2, 0.2), resolution_m=(0.2, 0.2))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (15.0, 45.0, 75.0)]
LOW, HIGH = np.array([-2.0, -1.0, 0.0]), np.array([3.0, 1.2, 1.5])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def box_points(count: int = 4000) -> np.ndarray:
    return LOW + (HIGH - LOW) * torch.rand(count, 3, generator=seeded(5), dtype=torch.float64).numpy()


def masks(points: np.ndarray, views: Sequence[View] = VIEWS) -> np.ndarray:
    """One bright pixel for every point, as if nothing were in shadow."""
    images = np.zeros((len(views), GRID.rows, GRID.columns), np.float32)
    for image, view in zip(images, views):
        x, _, r = radar_frame(view) @ points.T
        rows = np.rint((r - GRID.range_m[0]) / GRID.spacing_m[1]).astype(int)
        image[rows, np.rint((x - GRID.azimuth_m[0]) / GRID.spacing_m[0]).astype(int)] = 1.0
    return images


def inside(region: Region, points: np.ndarray) -> np.ndarray:
    return (points @ region.normals.T <= region.offsets).all(axis=1)


def test_region_holds_the_target_and_little_more():
    region = bounded_region(masks(box_points()), VIEWS, GRID)
    assert inside(region, box_points()).all()
    assert (region.low <= LOW + 0.05).all()
    assert (region.high >= HIGH - 0.05).all()
    assert region.low[2] == pytest.approx(0.0, abs=1e-9)  # the ground
    # azimuths bound the plan to a pixel on every side; ranges bound the height less closely
    assert (region.low[:2] >= LOW[:2] - 0.5).all()
    assert (region.high[:2] <= HIGH[:2] + 0.5).all()
    assert region.high[2] < 3.0
    bright = box_points()
    bright[:, 0] += 1.0  # another target, another place
    assert bounded_region(masks(bright), VIEWS, GRID).high[0] == pytest.approx(region.high[0] + 1.0, abs=0.3)


@pytest.mark.parametrize("grazing", [45.0, -20.0])
def test_aloft_the_region_ends_behind_what_frames_show(grazing: float) -> None:
    """All radars are on one side, and nothing else says how far away from them the target reaches."""
    points = box_points() - np.array([0.5, 0.1, 0.75])
    views = [View.isar(View(azimuth, grazing, aloft=True).direction, (0, 0, 1)) for azimuth in range(0, 360, 30)]
    region = bounded_region(masks(points, views), views, GRID)
    assert inside(region, points).all()
    behind, slope = (region.low[2] if grazing > 0 else region.high[2]), math.radians(abs(grazing))
    # as far as a place at the edge of the plan may lie that one view shows as its farthest
    farthest = (2 * np.hypot(2.5 + 0.3, 1.1 + 0.3) * math.cos(slope) + 0.75 * math.sin(slope) + 0.3) / math.sin(slope)
    assert points[:, 2].max() <= abs(behind) <= farthest


def test_aloft_views_from_all_sides_bound_the_region_by_themselves() -> None:
    points = box_points() - np.array([0.5, 0.1, 0.75])
    sights = [sign * axis for axis in np.eye(3) + 0.01 for sign in (1, -1)]
    views = [View.isar(sight, np.roll(sight, 1) + 0.1) for sight in sights]
    region = bounded_region(masks(points, views), views, GRID)
    assert len(region.normals) == 3 * len(views)
    assert inside(region, points).all()


def test_dim_pixels_do_not_count():
    plain = masks(box_points())
    images = plain.copy()
    images[:, 0, 0] = np.maximum(images[:, 0, 0], 5e-4)  # −33 dB
    region, expected = bounded_region(images, VIEWS, GRID), bounded_region(plain, VIEWS, GRID)
    assert np.array_equal([*region.low, *region.high], [*expected.low, *expected.high])
    loose = bounded_region(images, VIEWS, GRID, threshold_db=-40.0)
    assert loose.high[2] > expected.high[2] + 0.5  # now the corner counts, which is near: what is high comes early


@pytest.mark.parametrize("db", [30, 40])
def test_a_corner_reflector_does_not_cut_the_target_off(db):
    images = masks(box_points())
    dim = np.float32(0.15) * images  # 8 dB below what is bright of it
    images = np.where(np.arange(GRID.columns) % 3 == 0, images, dim)
    expected = bounded_region(images, VIEWS, GRID)
    for image, target in zip(images, images.copy(), strict=True):
        rows, columns = np.nonzero(target)
        image[rows[len(rows) // 2], columns[len(rows) // 2]] = 10 ** (db / 10)
    region = bounded_region(images, VIEWS, GRID)
    np.testing.assert_allclose([*region.low, *region.high], [*expected.low, *expected.high])


def test_dark_image_and_contradictory_images():
    images = masks(box_points())
    images[4] = 0.0
    with pytest.raises(SarsplatError, match=r"the image at azimuth 45°, grazing 45° is dark everywhere"):
        bounded_region(images, VIEWS, GRID)
    images = np.zeros((len(VIEWS), GRID.rows, GRID.columns), np.float32)
    images[:, 60, 2] = 1.0  # at the left edge from every side
    with pytest.raises(SarsplatError, match="no region of space could explain the bright pixels"):
        bounded_region(images, VIEWS, GRID)


def test_samples_fill_the_region_and_follow_the_seed():
    region = bounded_region(masks(box_points()), VIEWS, GRID)
    points = region.sample(2000, seeded(3))
    assert points.shape == (2000, 3)
    assert inside(region, points).all()
    assert np.array_equal(points, region.sample(2000, seeded(3)))
    assert not np.array_equal(points, region.sample(2000, seeded(4)))
    box = Region.box(LOW, HIGH).sample(4000, seeded(1))
    assert box.min(axis=0) == pytest.approx(LOW, abs=0.02)
    assert box.max(axis=0) == pytest.approx(HIGH, abs=0.02)
    assert box.mean(axis=0) == pytest.approx((LOW + HIGH) / 2, abs=0.06)


def test_hemisphere_is_a_shell_above_the_ground():
    region = Region.box(LOW, HIGH)
    points = hemisphere_shell(region, 5000, seeded(0))
    centre = np.array([0.5, 0.1, 0.0])
    offset = points - centre
    radius = np.linalg.norm(HIGH[:2] - LOW[:2]) / 2  # around the region's plan
    assert np.linalg.norm(offset, axis=1) == pytest.approx(radius)
    assert (offset[:, 2] >= 0).all()
    assert offset[:, 2].mean() == pytest.approx(radius / 2, rel=0.03)  # even on the sphere: heights are uniform
    assert offset[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=0.05 * radius)
    assert np.array_equal(points, hemisphere_shell(region, 5000, seeded(0)))


def test_random_orientations_are_uniform():
    q = random_quaternions(20_000, seeded(2))
    assert q.norm(dim=1) == pytest.approx(torch.ones(20_000), abs=1e-6)
    assert (q.T @ q / 20_000).numpy() == pytest.approx(np.eye(4) / 4, abs=0.01)
