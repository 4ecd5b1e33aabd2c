"""Terrain: its brightness, layover and shadow against closed forms, what it hides, and that a flat one is the plane."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from named_scenes import GRID, MATRIX, VIEWS, cloud, wall

from made import hill, slope, terrain
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer import render
from sarsplat.renderer.echoes import lit_terrain

WIDE = ImageGrid(60, 24, (0.3, 0.1), (0.45, 0.16))
DTYPES = {"cpu": torch.float32, "reference": torch.float64}


def bare(ground: Terrain, view: View, grid: ImageGrid, engine: str = "cpu", rays: RayGrid | None = None) -> np.ndarray:
    """β⁰ of terrain alone over γ⁰."""
    dtype = DTYPES[engine]
    empty = cloud(1, 0)[:0].to(dtype)
    of = Ground(torch.tensor(0.2, dtype=dtype), height_m=ground)
    return render(empty, [view], grid, rays=rays, ground=of, engine=engine).images[0, 0].double().numpy() / 0.2


@pytest.mark.parametrize("engine", DTYPES)
@pytest.mark.parametrize("many", [False, True])
def test_flat_terrain_is_the_plane(engine, many):
    dtype = DTYPES[engine]
    flat = Terrain(np.full((4, 7), -0.55), (2.0, 1.5))
    gamma0 = torch.full((3, 5), 0.3, dtype=dtype) if many else torch.tensor(0.3, dtype=dtype)
    scene, exponent = cloud(20, 30).to(dtype), torch.tensor(1.2, dtype=dtype)
    shift = torch.tensor([[0.1, -0.2], [0.0, 0.3], [-0.2, 0.1]], dtype=dtype)
    found, expected = (
        render(scene, VIEWS, GRID, shift=shift, ground=Ground(gamma0, 0.9, height, exponent), engine=engine)
        for height in (flat, -0.55)
    )
    torch.testing.assert_close(found.images, expected.images, rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(found.lit_area, expected.lit_area)


@pytest.mark.parametrize("engine", DTYPES)
@pytest.mark.parametrize(("grazing", "tilt"), [(40.0, 15.0), (40.0, -15.0), (60.0, 45.0), (20.0, -19.0), (75.0, 5.0)])
def test_a_slope_is_as_bright_as_its_own_angle_makes_it(engine, grazing, tilt):
    """β⁰ = γ⁰·tan(θ + tilt), beyond 90° in layover over what is level before and behind it.

    Seen from the side, a tilt moves places but leaves their areas.
    """
    theta = math.radians(grazing + tilt)
    ground = slope(tilt)
    rays = RayGrid((0.21, 0.07))
    toward = bare(ground, View(0.0, grazing), WIDE, engine, rays)[20:40, 5:-5]
    level = math.tan(math.radians(grazing))
    np.testing.assert_allclose(toward, abs(math.tan(theta)) + (2 * level if grazing + tilt > 90 else 0), rtol=2e-4)
    beside = bare(ground, View(90.0, grazing), WIDE, engine, rays)[20:40, 5:-5]
    np.testing.assert_allclose(beside, level, rtol=2e-4)


def test_a_slope_that_falls_away_more_steeply_than_rays_is_dark():
    assert bare(slope(-35.0), View(0.0, 25.0), WIDE).max() < 1e-6


@pytest.mark.parametrize(("grazing", "fall"), [(30.0, 0.0), (40.0, 10.0), (40.0, -15.0)])
def test_the_shadow_of_a_ridge_on_a_slope(grazing, fall):
    """The ray over a crest of height h meets the ground h / (tan θ − tan of its fall) behind it."""
    theta, down, height = math.radians(grazing), math.tan(math.radians(fall)), 1.0

    def profile(x, y):  # the radar is at +x; steeper than rays, and ground that falls behind
        return np.maximum(height * (1 - np.abs(x) / 0.75), np.minimum(x, 0) * down) + 0 * y

    ground, grid = terrain(profile, pitch_m=(0.25, 1.0)), ImageGrid(90, 16, (0.3, 0.06), (0.45, 0.09))
    image = bare(ground, View(0.0, grazing), grid, rays=RayGrid((0.3, 0.01)))
    level = image[:, 5:-5].mean(1) / math.tan(theta - math.radians(fall))
    far = height / (math.tan(theta) - down)  # on the ground, behind the crest
    edge = far * math.cos(theta) + far * down * math.sin(theta)
    shadow = (grid.range_m > 0.15) & (grid.range_m < edge - 0.2)
    assert shadow.sum() >= 2
    assert level[shadow].max() < 2e-3
    assert level[(grid.range_m > edge + 0.15) & (grid.range_m < edge + 0.6)] == pytest.approx(1.0, abs=5e-3)
    around = np.flatnonzero(np.abs(grid.range_m - edge) < 0.15)
    assert np.interp(0.5, level[around], grid.range_m[around]) == pytest.approx(edge, abs=0.03)


def test_what_terrain_returns_is_what_rays_find():
    """Energy: all rays that end within the image return γ⁰ times their area, whatever the hills."""
    grid, view = ImageGrid(120, 100, (0.3, 0.3), (0.4, 0.4)), View(30.0, 55.0)
    lower = terrain(lambda x, y: 0 * x * y, (15.0, 15.0))
    bump = terrain(lambda x, y: 2.0 * np.exp(-(x**2 + y**2) / 4), (15.0, 15.0))
    flat, bumpy = (bare(one, view, grid).sum() for one in (lower, bump))
    assert bumpy == pytest.approx(flat, rel=1e-4)
    assert np.abs(bare(bump, view, grid) - bare(lower, view, grid)).max() > 1.0


def test_weights_that_are_computed_again_are_those_that_would_be_kept(monkeypatch):
    scene, found = MATRIX["terrain, shifted"](), []
    for at_a_time in (lit_terrain._MAX_SAVED, 5000):
        monkeypatch.setattr(lit_terrain, "_MAX_SAVED", at_a_time)
        leaves = scene.leaves(torch.float64)
        images = scene.call(render, leaves, engine="reference").images
        found.append([images.detach(), *torch.autograd.grad(images.square().sum(), list(leaves.values()))])
    for kept, again in zip(*found, strict=True):
        assert torch.allclose(kept, again, rtol=1e-12, atol=1e-14)


def test_a_hill_hides_what_is_behind_it_and_only_from_there():
    ground = Ground(torch.tensor(0.3), height_m=hill(2.5, at=(2.0, 0.0), width_m=0.8))
    scene = cloud(20, 1, size=(0.4, 0.8, 0.3), scale=0.05)
    scene = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 0.5]))
    views = [View(0.0, 20.0), View(180.0, 20.0), View(0.0, 70.0)]
    both, alone = (render(one, views, GRID, ground=ground) for one in (scene, scene[:0]))
    assert not both.lit_area[0].any()
    torch.testing.assert_close(both.images[0], alone.images[0])
    assert (both.lit_area[1:].sum(1) > 0.05).all()
    buried = replace(scene, means=scene.means - torch.tensor([0.0, 0.0, 3.0]))
    torch.testing.assert_close(render(buried, views, GRID, ground=ground).images, alone.images)


def test_a_wall_on_a_slope_hides_more_of_it_the_more_it_falls():
    """An opaque wall of 2 m across the line of sight hides the slope to 2 m / (tan θ − tan of the fall) behind it."""
    height, grazing = 2.0, 45.0
    grid = ImageGrid(120, 24, (0.1, 0.06), (0.15, 0.09))
    for fall in (-12.0, 0.0, 12.0):
        theta, down = math.radians(grazing), math.tan(math.radians(fall))
        ground = Ground(torch.tensor(0.3), height_m=slope(-fall))
        image = render(
            wall(height, -0.075), [View(0.0, grazing)], grid, rays=RayGrid((0.02, 0.02)), ground=ground
        ).images[0, 0]
        level = image[:, 8:16].mean(1).double().numpy() / (0.3 * math.tan(theta - math.radians(fall)))
        far = height / (math.tan(theta) - down)
        edge = far * math.cos(theta) + far * down * math.sin(theta)
        around = np.flatnonzero(np.abs(grid.range_m - edge) < 0.3)
        found = np.interp(0.5, level[around], grid.range_m[around])
        assert found == pytest.approx(edge, abs=0.05 / math.tan(theta - math.radians(fall)))
        assert level[(grid.range_m > 0.2) & (grid.range_m < edge - 0.3)].max() < 5e-3


def test_angles_at_which_a_ray_is_far_longer_than_the_terrain_are_refused_with_one_that_is_not():
    with pytest.raises(SarsplatError, match=r"grazing 1e-05° looks along \S+ m of ground to see \S+ m") as refused:
        bare(hill(), View(20, 1e-5), GRID)
    least = float(re.search(r"at least (\S+)°", str(refused.value))[1])
    assert least < 0.05
    assert np.isfinite(bare(hill(), View(20, least), GRID)).all()
