"""The ray caster against closed forms, against itself (convergence), and on terrain against the renderer."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from made import hill, slope, upright
from sarsplat import Ground, ImageGrid, ScatteringLaw, Terrain, View, radar_frame, render
from sarsplat.geometry.responses import TAYLOR, Sampled
from sarsplat.scenes import paper_grid, raycast, simulate_raycast, target_mesh
from sarsplat.scenes._patches import Patches
from sarsplat.scenes._rays import tracer
from sarsplat.scenes._shapes import box

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

CONSTANT = ScatteringLaw(floor=1.0, lobe=0.0)  # γ⁰ = 1 at every incidence
GRID = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))
BELOW = pytest.mark.filterwarnings("ignore:.*of the target's surface is below the ground")


@pytest.fixture(scope="module")
def t72():
    return target_mesh("t72")


PLATE, WALL = box((-40, 40), (-40, 40), (-1, 0)), box((-1, 0), (-20, 20), (-10, 10))


@pytest.mark.parametrize("grazing", [15.0, 45.0, 75.0])
@pytest.mark.parametrize(("mesh", "azimuth", "slope"), [(PLATE, 30, math.tan), (WALL, 0, lambda t: 1 / math.tan(t))])
def test_ground_and_walls_have_the_level_of_their_slope(mesh, azimuth, slope, grazing):
    """γ⁰ tan θ, and γ⁰ / tan θ of the face x = 0 seen from azimuth 0."""
    law, theta = ScatteringLaw(0.1, 0.9), math.radians(grazing)
    image = simulate_raycast(mesh, View(azimuth, grazing), GRID, law, ray_spacing=0.04)
    cosine = math.sin(theta) if mesh is PLATE else math.cos(theta)
    np.testing.assert_allclose(image[28:36, 8:-8], law.gamma0(np.array([cosine])).item() * slope(theta), rtol=1e-3)


def test_energy_is_the_cross_section():
    grid = ImageGrid(64, 64, (0.3, 0.3), (0.6, 0.6))  # at resolution = spacing the pixel lattice would ripple
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    image = simulate_raycast(sphere, View(20, 40), grid, ScatteringLaw(0.1, 0.9))
    # ∫ γ⁰ over the projected disc: cos²i averages ½ over it.
    assert image.sum() * 0.09 == pytest.approx(math.pi * 4 * (0.1 + 0.9 / 2), rel=2e-3)


def test_a_point_target_is_the_response_at_the_right_pixel():
    grid = ImageGrid(65, 33, (0.2, 0.25), (0.4, 0.5), center_m=(1.0, -2.0))
    view = View(70, 35)
    target = trimesh.creation.icosphere(subdivisions=3, radius=0.005)
    # two columns to the right of the centre, four rows behind it
    target.apply_translation(radar_frame(view).T @ np.array([1.4, 3.0, -1.0]))
    image = simulate_raycast(target, view, grid, CONSTANT, ray_spacing=0.0002)
    row, column = 32 + 4, 16 + 2
    peak = math.pi * 0.005**2 * 4 * math.log(2) / (math.pi * 0.4 * 0.5)
    assert image[row, column] == pytest.approx(peak, rel=0.02)
    # One pixel is half the 3 dB width on either axis. The sphere's front is 3 mm nearer than its centre.
    for neighbour in ((row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)):
        assert image[neighbour] / image[row, column] == pytest.approx(0.5, rel=0.02)


def test_a_point_target_has_the_side_lobes_of_the_response():
    grid = ImageGrid(161, 161, (0.05, 0.08), (0.3, 0.4), response=TAYLOR)
    point = trimesh.creation.icosphere(subdivisions=3, radius=0.0005)
    image = simulate_raycast(point, View(0, 45), grid, CONSTANT, ray_spacing=0.00002)
    level = 10 * np.log10(image / image.max())
    for cut, step in ((level[80, 80:], 0.05 / 0.3), (level[80:, 80], 0.08 / 0.4)):
        places = np.arange(81) * step
        expected = 10 * np.log10(TAYLOR.density(places) / TAYLOR.density(np.zeros(1)))
        beyond = (places > TAYLOR.main_lobe) & (expected > -45)
        assert beyond.sum() > 5
        assert cut[beyond].max() == pytest.approx(-35.2, abs=0.4)  # between pixels, it is a little higher
        np.testing.assert_allclose(cut[beyond], expected[beyond], atol=0.2)
        np.testing.assert_allclose(cut[places < 0.9], expected[places < 0.9], atol=0.05)
    assert image.sum() * 0.004 == pytest.approx(math.pi * 0.0005**2, rel=0.01)  # its cross-section
    flat = replace(grid, response=Sampled((0, 0.5, 0.5001, 2, 3), (1, 1, 0.1, 0.1, 0)))
    image = simulate_raycast(point, View(0, 45), flat, CONSTANT, ray_spacing=0.00002)
    assert image[80, 81] == pytest.approx(image[80, 80], rel=0.01)
    assert image[80, 86] == pytest.approx(0.1 * image[80, 80], rel=0.01)


@BELOW
def test_what_lies_below_the_ground_is_not_seen():
    buried = box((-2, 2), (-2, 2), (-3, -1))
    image = simulate_raycast(buried, View(0, 45), GRID, CONSTANT, ground_gamma0=0.2)
    np.testing.assert_allclose(image, 0.2, rtol=1e-6)
    assert simulate_raycast(buried, View(0, 45), GRID, CONSTANT).max() > 0.5  # and without ground it is


def test_near_surfaces_hide_far_ones_and_facets_scatter_from_both_sides():
    law, front = ScatteringLaw(0.1, 0.9), box((-0.1, 0), (-3, 3), (-3, 3))
    inverted = trimesh.Trimesh(front.vertices, front.faces[:, ::-1], process=False)
    both = trimesh.util.concatenate([front, box((-2, -1), (-1, 1), (-1, 1))])  # seen almost along the horizon
    usual, again, hiding = (simulate_raycast(mesh, View(0, 5), GRID, law) for mesh in (front, inverted, both))
    np.testing.assert_allclose(again, usual, rtol=1e-6)
    np.testing.assert_allclose(hiding, usual, rtol=2e-3, atol=1e-6)  # hidden edges make rays denser


def test_turning_the_target_against_the_view_changes_nothing(t72):
    turned = t72.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(math.radians(37), (0, 0, 1)))
    image = simulate_raycast(t72, View(60, 45), GRID, ScatteringLaw())
    again = simulate_raycast(turned, View(60 - 37, 45), GRID, ScatteringLaw())
    assert np.abs(np.sqrt(image) - np.sqrt(again)).max() < 2e-3 * np.sqrt(image.max())


@cache
def amplitude(mesh, view, **settings):
    """Of an image that nobody changes."""
    return np.sqrt(simulate_raycast(mesh, view, paper_grid(), ScatteringLaw(), **settings).astype(np.float64))


@pytest.mark.parametrize(
    ("view", "settings", "least_db"),
    [
        *((View(*angles), {"ray_offset": (0.0, 0.0)}, 65) for angles in ((0, 15), (45, 45), (330, 75))),
        (View(90, 75), {"ray_offset": (0.2, 0.7)}, 65),
        (View(45, 45), {"oversample": 27}, 80),
    ],
)
def test_other_rays_and_a_finer_histogram_change_nothing(t72, view, settings, least_db):
    usual, other = amplitude(t72, view), amplitude(t72, view, **settings)
    assert -10 * math.log10(np.mean((other - usual) ** 2) / usual.max() ** 2) >= least_db


# ---- rays as sparse as flat surfaces allow ---------------------------------------------------------------------------
def test_flat_surfaces_need_few_rays_however_they_are_divided(monkeypatch):
    """A house in few faces or in many takes the same few rays, and has the image of a dense lattice of them."""
    house = trimesh.util.concatenate([box((-5, 5), (-4, 4), (0, 6)), box((1, 1.8), (1, 1.8), (5, 8))])
    traced = []

    def counted(facets):
        trace = tracer(facets)

        def count(position):
            traced.append(len(position))
            return trace(position)

        return count

    monkeypatch.setattr(raycast, "tracer", counted)
    images, rays = [], []
    for mesh in (house, house.subdivide().subdivide().subdivide().subdivide().subdivide()):
        traced.clear()
        images.append(simulate_raycast(mesh, View(20, 35), GRID, ScatteringLaw(), ground_gamma0=0.05))
        rays.append(sum(traced))
    assert rays[1] < 1.1 * rays[0]
    np.testing.assert_allclose(images[1], images[0], atol=2e-3 * images[0].max())
    # no square is flat where every face is a part of its own
    traced.clear()
    mottled = 1 + 1e-9 * np.arange(len(mesh.faces))
    dense = simulate_raycast(mesh, View(20, 35), GRID, ScatteringLaw(), ground_gamma0=0.05, reflectivity=mottled)
    assert sum(traced) > 3 * rays[0]
    seen = dense > 1e-3 * dense.max()
    assert np.sqrt(np.mean((10 * np.log10(images[0][seen] / dense[seen])) ** 2)) < 0.02  # dB


def test_what_is_thinner_than_a_square_of_rays_is_not_missed():
    """Wires of 2 cm in squares of 16 cm; the facets of one are so fine that neighbours are nearly in a plane."""
    wall = box((-1, 0), (-4, 4), (0, 8))
    wire = trimesh.creation.cylinder(0.01, segment=[(1, -2, 2), (1, 2, 6)], sections=6)
    smooth = trimesh.creation.cylinder(0.01, segment=[(1, -2, 6), (1, 2, 2)], sections=600)
    law = ScatteringLaw(0.0, 1.0, 1.0)
    for thin in (wire, smooth):
        both = trimesh.util.concatenate([wall, thin])
        for mesh in (thin, both):
            usual, fine = (simulate_raycast(mesh, View(0, 30), GRID, law, ray_spacing=d) for d in (0.02, 0.007))
            assert usual.sum() == pytest.approx(fine.sum(), rel=0.02)


def test_patches_are_connected_flat_and_of_one_reflectivity():
    cube = trimesh.creation.box((2, 2, 2))
    assert len(Patches.of(cube, np.ones(12)).largest_face) == 6
    assert len(Patches.of(cube, np.arange(12.0)).largest_face) == 12
    apart = trimesh.util.concatenate([cube, cube.copy().apply_translation((4, 0, 0))])
    assert len(Patches.of(apart, np.ones(24)).largest_face) == 12
    soup = trimesh.Trimesh(cube.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    assert len(Patches.of(soup, np.ones(12)).largest_face) == 6
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert len(Patches.of(ball, np.ones(len(ball.faces))).largest_face) == len(ball.faces)
    bent = trimesh.creation.cylinder(1.0, 0.01, sections=20_000)  # each edge is flat to rounding, all of them are not
    side = np.abs(bent.face_normals[:, 2]) < 0.5
    patches = Patches.of(bent, np.ones(len(bent.faces)))
    assert len(np.unique(patches.of_face[side])) == side.sum()


def test_a_mesh_far_larger_than_the_image_costs_no_more(monkeypatch):
    """Rays stand only where they can meet the image."""
    rows, hits = [], raycast.sparse_hits
    monkeypatch.setattr(raycast, "sparse_hits", lambda *a: rows.append(a[3]) or hits(*a))
    image = simulate_raycast(box((-500, 500), (-500, 500), (-1, 3)), View(0, 30), GRID, CONSTANT)
    np.testing.assert_allclose(image, math.tan(math.radians(30)), rtol=1e-3)
    (region,) = rows
    assert region.x[1] - region.x[0] < 64 * 0.3 + 3
    assert region.y[1] - region.y[0] < (64 * 0.3 + 3) * math.tan(math.radians(30)) + 4 / math.cos(math.radians(30)) + 1


def test_the_error_of_the_rays_is_what_finer_rays_tell(t72):
    view, grid, law = View(30, 45), paper_grid(), ScatteringLaw()
    coarse, fine = (simulate_raycast(t72, view, grid, law, ray_spacing=d).astype(np.float64) for d in (0.03, 0.0075))
    seen = fine > 1e-3 * fine.max()
    true = np.sqrt(np.mean((10 * np.log10(coarse[seen] / fine[seen])) ** 2))
    settings = {"reflectivity": None, "ground_gamma0": None, "terrain": None}
    assert raycast.ray_error_db(t72, view, grid, law, ray_spacing=0.03, **settings) == pytest.approx(true, rel=0.5)
    beside = t72.copy().apply_translation((200, 200, 0))
    assert raycast.ray_error_db(beside, view, grid, law, ray_spacing=0.03, **settings) is None


# ---- on terrain: closed forms, and the renderer, which shares nothing with it ----------------------------------------
HILLY = ImageGrid(48, 48, (0.3, 0.3), (0.45, 0.45))
LAW = ScatteringLaw(0.5, 0.0)


BURIED = box((-0.5, 0.5), (-0.5, 0.5), (-50.5, -49.5))


def cast(mesh: trimesh.Trimesh, view: View, ground: Terrain, law: ScatteringLaw = LAW, **settings: float) -> np.ndarray:
    settings = {"ground_gamma0": 0.2, "ray_spacing": 0.05, **settings}
    return simulate_raycast(mesh, view, HILLY, law, terrain=ground, **settings)


@BELOW
@pytest.mark.parametrize(
    ("azimuth", "grazing", "ground", "angle"),
    [
        *((0.0, grazing, slope(tilt), grazing + tilt) for grazing, tilt in ((40.0, 15.0), (40.0, -15.0), (20.0, 0.0))),
        (70.0, 45.0, Terrain(np.zeros((2, 2)), (1.0, 1.0)), 45.0),  # level beyond its end
    ],
)
def test_a_slope_is_as_bright_as_its_own_angle_makes_it(azimuth, grazing, ground, angle):
    image = cast(BURIED, View(azimuth, grazing), ground)[12:-12, 12:-12]
    assert image == pytest.approx(np.full((24, 24), 0.2 * math.tan(math.radians(angle))), rel=2e-3)


@BELOW
@pytest.mark.parametrize("view", [View(20.0, 30.0), View(200.0, 55.0)])
def test_a_hill_looks_as_the_renderer_shows_it(view):
    """Of which the squares of terrain are curved, and here two triangles each."""
    ground = hill(2.0)
    rays = cast(BURIED, view, ground, ray_spacing=0.08)
    shown = render(upright([]), [view], HILLY, ground=Ground(torch.tensor(0.2), height_m=ground))
    rendered = shown.images[0, 0].numpy()
    level = 0.2 * math.tan(math.radians(view.grazing_deg))
    assert rendered.max() > 1.5 * level  # its front, and in one of them its shadow
    assert rendered.min() < 0.5 * level
    error = rays - rendered
    assert math.sqrt(float((error**2).mean())) < 0.03 * level
    assert abs(float(error.mean())) < 3e-3 * level


@BELOW
def test_hills_hide_targets_and_targets_hills():
    view, ground = View(0.0, 20.0), hill(2.5, at=(3.0, 0.0), width_m=1.4)
    behind, before = (box((x - 0.5, x + 0.5), (-0.5, 0.5), (0.1, 1.1)) for x in (0.0, 6.3))
    shade, lit = (cast(cube, view, ground, ground_gamma0=0.0) for cube in (behind, before))
    assert shade.max() == 0.0
    assert lit.max() > 0.1
    large = box((5.3, 7.3), (-1, 1), (0.5, 2.5))
    bare, hidden = (cast(cube, view, ground, ScatteringLaw(0.0, 0.0)) for cube in (BURIED, large))
    assert hidden.sum() < bare.sum() - 1.0
    assert (hidden <= bare + 1e-4).all()
