"""Tilted azimuth axes, and radars that look to the left: symmetry, ground, and ray casting as a witness."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from named_scenes import GRID, UNUSUAL, cloud

from made import slope
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, View
from sarsplat.renderer import render
from sarsplat.renderer.echoes import GroundEcho
from sarsplat.scenes import ScatteringLaw, simulate_raycast
from sarsplat.scenes.simulate import simulate_images

PLANE = GroundEcho(Ground(torch.tensor(0.2), height_m=-0.3))


def test_left_is_right_mirrored_bit_for_bit():
    right = render(cloud(60, 0), [View(70.0, 40.0, 12.0)], GRID, echoes=[PLANE]).images
    left = render(cloud(60, 0), [View(70.0, 40.0, -12.0, "left")], GRID, echoes=[PLANE]).images
    assert right.amax() > 2 * right.median()
    assert left.flip(-1) == pytest.approx(right, rel=1e-5, abs=1e-6)


def test_a_small_tilt_changes_little():
    level, tilted = (
        render(cloud(60, 0), [View(70.0, 40.0, tilt)], GRID, echoes=[PLANE]).images for tilt in (0.0, 1e-4)
    )
    assert (level - tilted).abs().max() < 1e-4 * level.max()


@pytest.mark.parametrize("view", UNUSUAL, ids=str)
def test_free_ground_is_flat_and_has_its_level(view):
    scene = replace(cloud(1, 0), optical_depth=torch.zeros(1))
    (image,) = render(scene, [view], GRID, echoes=[PLANE]).images
    level = 0.2 * math.tan(math.radians(view.grazing_deg)) / math.cos(math.radians(view.tilt_deg))
    assert image[0].numpy() == pytest.approx(np.full((GRID.rows, GRID.columns), level), rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ground_of_level_views_is_the_same_beside_tilted_ones(dtype):
    scene = replace(cloud(60, 0), means=cloud(60, 0).means + torch.tensor([0.0, 0.0, 1.0])).to(dtype)
    ground = Ground(torch.tensor(0.2, dtype=dtype), height_m=-0.3)
    views = [View(70.0, 40.0), *UNUSUAL]
    together = render(scene, views, GRID, ground=ground).ground
    assert together is not None
    for image, view in zip(together, views, strict=True):
        alone = render(scene, [view], GRID, ground=ground).ground
        assert alone is not None
        torch.testing.assert_close(image, alone[0], rtol=1e-5, atol=1e-6)


def test_terrain_is_refused_under_a_tilt():
    terrain = GroundEcho(Ground(torch.tensor(0.2), height_m=slope(5.0)))
    with pytest.raises(SarsplatError, match="tilted by 25°, under which only level ground can be rendered"):
        render(cloud(5, 0), UNUSUAL[:1], GRID, echoes=[terrain])


@pytest.mark.parametrize("view", UNUSUAL, ids=str)
def test_a_box_on_the_ground_is_imaged_as_by_ray_casting(view):
    """Layover, brightness and shadow lie along the tilted image's own axes."""
    pytest.importorskip("embreex")
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    box.apply_translation([0.2, 0.1, 0.4])
    grid = ImageGrid(40, 40, (0.15, 0.15), (0.25, 0.25))
    how = {"law": ScatteringLaw(), "ground_gamma0": 0.05}
    traced = simulate_raycast(box, view, grid, how["law"], ground_gamma0=0.05)
    splat = simulate_images(box, [view], grid, source="splat", **how)[0]
    assert np.corrcoef(traced.ravel(), splat.ravel())[0, 1] > 0.995
    assert splat.sum() == pytest.approx(traced.sum(), rel=0.03)
    assert (traced < 0.2 * np.median(traced)).any()  # its shadow
