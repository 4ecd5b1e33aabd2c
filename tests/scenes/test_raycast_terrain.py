"""Ray casting on terrain: closed forms, and the renderer, which shares nothing with it."""

import math

import numpy as np
import pytest
import torch
import trimesh

from made import hill, slope, upright
from sarsplat import Ground, ImageGrid, ScatteringLaw, Terrain, View, render
from sarsplat.scenes.raycast import simulate_raycast

pytestmark = pytest.mark.filterwarnings("ignore:.*of the target's surface is below the ground")

GRID = ImageGrid(48, 48, (0.3, 0.3), (0.45, 0.45))
LAW = ScatteringLaw(0.5, 0.0)


def box(z: float, side: float = 1.0, x: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box((side, side, side)).apply_translation((x, 0.0, z))


BURIED = box(-50.0)


def cast(mesh: trimesh.Trimesh, view: View, ground: Terrain, law: ScatteringLaw = LAW, **settings: float) -> np.ndarray:
    settings = {"ground_gamma0": 0.2, "ray_spacing": 0.05, **settings}
    return simulate_raycast(mesh, view, GRID, law, terrain=ground, **settings)


@pytest.mark.parametrize(("grazing", "tilt"), [(40.0, 15.0), (40.0, -15.0), (20.0, 0.0)])
def test_a_slope_is_as_bright_as_its_own_angle_makes_it(grazing, tilt):
    image = cast(BURIED, View(0.0, grazing), slope(tilt))
    expected = 0.2 * math.tan(math.radians(grazing + tilt))
    assert image[12:-12, 12:-12] == pytest.approx(np.full((24, 24), expected), rel=2e-3)


@pytest.mark.parametrize("view", [View(20.0, 30.0), View(200.0, 55.0)])
def test_a_hill_looks_as_the_renderer_shows_it(view):
    """Of which the squares of terrain are curved, and here two triangles each."""
    ground = hill(2.0)
    rays = cast(BURIED, view, ground, ray_spacing=0.08)
    rendered = render(upright([]), [view], GRID, ground=Ground(torch.tensor(0.2), height_m=ground)).images[0, 0].numpy()
    level = 0.2 * math.tan(math.radians(view.grazing_deg))
    assert rendered.max() > 1.5 * level  # its front, and in one of them its shadow
    assert rendered.min() < 0.5 * level
    error = rays - rendered
    assert math.sqrt(float((error**2).mean())) < 0.03 * level
    assert abs(float(error.mean())) < 3e-3 * level


def test_hills_hide_targets_and_targets_hills():
    view, ground = View(0.0, 20.0), hill(2.5, at=(3.0, 0.0), width_m=1.4)
    shade, lit = (cast(one, view, ground, ground_gamma0=0.0) for one in (box(0.6), box(0.6, x=6.3)))
    assert shade.max() == 0.0
    assert lit.max() > 0.1
    bare, behind = (cast(one, view, ground, ScatteringLaw(0.0, 0.0)) for one in (BURIED, box(1.5, 2.0, x=6.3)))
    assert behind.sum() < bare.sum() - 1.0
    assert (behind <= bare + 1e-4).all()


def test_level_beyond_its_end():
    image = cast(BURIED, View(70.0, 45.0), Terrain(np.zeros((2, 2)), (1.0, 1.0)))
    assert image == pytest.approx(np.full(image.shape, 0.2), rel=2e-3)
