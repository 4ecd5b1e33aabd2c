"""The ray-cast simulator against closed forms (physics), against itself (convergence), and its errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.geometry.responses import TAYLOR, Sampled
from sarsplat.scenes import ScatteringLaw, paper_grid, simulate_raycast, target_mesh

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

CONSTANT = ScatteringLaw(floor=1.0, lobe=0.0)  # γ⁰ = 1 at every incidence
GRID = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))


def box(x, y, z):
    return trimesh.creation.box(bounds=np.array([x, y, z], dtype=float).T)


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


@pytest.mark.parametrize(("grazing", "shadow"), [(15.0, (0.5, 9.0)), (45.0, (0.5, 3.7)), (75.0, None)])
def test_free_ground_is_exact_and_full_shadow_dark(grazing, shadow):
    slab = box((-0.2, 0), (-6, 6), (0, 6))  # its shadow: slant range 0 to height·cosθ / tanθ, less its layover
    image = simulate_raycast(slab, View(0, grazing), GRID, CONSTANT, ground_gamma0=0.2)
    free = 0.2 * math.tan(math.radians(grazing))
    np.testing.assert_allclose(image[:, :8], free, rtol=1e-6)
    if shadow:
        dark = (GRID.range_m > shadow[0]) & (GRID.range_m < shadow[1])
        assert image[dark][:, 24:40].max() < 1e-3 * free


def test_what_lies_below_the_ground_is_not_seen():
    buried = box((-2, 2), (-2, 2), (-3, -1))
    image = simulate_raycast(buried, View(0, 45), GRID, CONSTANT, ground_gamma0=0.2)
    np.testing.assert_allclose(image, 0.2, rtol=1e-6)
    assert simulate_raycast(buried, View(0, 45), GRID, CONSTANT).max() > 0.5  # and without ground it is


def test_facets_scatter_from_both_sides():
    plate = trimesh.Trimesh([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    inverted = trimesh.Trimesh(plate.vertices, plate.faces[:, ::-1], process=False)
    images = [simulate_raycast(mesh, View(10, 50), GRID, ScatteringLaw(0.1, 0.9)) for mesh in (plate, inverted)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-6)


def test_near_surfaces_hide_far_ones():
    front = box((-0.1, 0), (-3, 3), (-3, 3))
    both = trimesh.util.concatenate([front, box((-2, -1), (-1, 1), (-1, 1))])  # seen almost along the horizon
    images = [simulate_raycast(mesh, View(0, 5), GRID, CONSTANT) for mesh in (front, both)]
    np.testing.assert_array_equal(images[0], images[1])


def test_turning_the_target_against_the_view_changes_nothing(t72):
    turned = t72.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(math.radians(37), (0, 0, 1)))
    image = simulate_raycast(t72, View(60, 45), GRID, ScatteringLaw())
    again = simulate_raycast(turned, View(60 - 37, 45), GRID, ScatteringLaw())
    assert np.abs(np.sqrt(image) - np.sqrt(again)).max() < 2e-3 * np.sqrt(image.max())


@pytest.mark.parametrize(
    ("view", "settings", "least_db"),
    [
        *((View(*angles), {"ray_offset": (0.0, 0.0)}, 65) for angles in ((0, 15), (45, 45), (330, 75), (90, 75))),
        *((View(*angles), {"ray_offset": (0.2, 0.7)}, 65) for angles in ((0, 15), (45, 45), (330, 75), (90, 75))),
        (View(45, 45), {"oversample": 27}, 80),
    ],
)
def test_other_rays_and_a_finer_histogram_change_nothing(t72, view, settings, least_db):
    usual, other = (
        np.sqrt(simulate_raycast(t72, view, paper_grid(), ScatteringLaw(), **options).astype(np.float64))
        for options in ({}, settings)
    )
    assert -10 * math.log10(np.mean((other - usual) ** 2) / usual.max() ** 2) >= least_db


def test_large_scenes_are_cut_to_the_swath_and_batched():
    grid = ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3))
    image = simulate_raycast(box((-200, 200), (-200, 200), (-1, 0)), View(0, 45), grid, CONSTANT, ray_spacing=0.08)
    np.testing.assert_allclose(image, 1.0, rtol=1e-3)


def test_target_beside_the_image_leaves_it_empty():
    image = simulate_raycast(box((-1, 1), (99, 101), (0, 1)), View(0, 45), GRID, CONSTANT)
    assert (image.shape, image.dtype, image.max()) == ((64, 64), np.float32, 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ray_spacing": 0.0}, "ray_spacing 0.0 must be positive"),
        ({"ray_spacing": math.nan}, "ray_spacing nan must be positive"),
        ({"ray_offset": (math.nan, 0.0)}, r"ray_offset \(nan, 0.0\) must be two finite numbers"),
        ({"oversample": 0}, "oversample 0 must be a whole number"),
        ({"oversample": 2.5}, "oversample is 2.5; give a whole number"),
        ({"oversample": 1}, "too fine for image nodes"),
        ({"ground_gamma0": -10.0}, "ground_gamma0 -10.0 must be finite and at least 0"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(SarsplatError, match=message):
        simulate_raycast(box((-1, 1), (-1, 1), (0, 1)), View(0, 45), GRID, CONSTANT, **settings)


def test_a_mesh_with_a_vertex_that_is_not_finite_is_refused():
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, math.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(SarsplatError, match="has a vertex that is not finite"):
        simulate_raycast(broken, View(0, 45), GRID, CONSTANT)
