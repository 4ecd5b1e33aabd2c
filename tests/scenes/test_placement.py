"""Where meshes stand: in their images, and on the ground."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import Stack, Terrain, View
from sarsplat.scenes import ScatteringLaw, paper_grid, simulate_raycast, simulate_stack
from sarsplat.scenes.placement import lost_digits, outside_images, recentred, shown_in, warn_below_ground
from sarsplat.scenes.simulate import simulate_images

trimesh = pytest.importorskip("trimesh")

GRID = paper_grid()
VIEWS = [View(azimuth, 30) for azimuth in range(0, 360, 45)]


def below_ground(mesh, grid, terrain):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_below_ground(mesh, grid, 0.1, terrain)
    return [str(one.message) for one in caught]


def box(x: float = 0, y: float = 0, z: float = 1):
    return trimesh.creation.box((6, 3, 2)).apply_translation((x, y, z))


@pytest.mark.parametrize("place", [(5e5, 5.2e6, 401), (0, 0, 500), (60, 0, 1)])
def test_a_mesh_outside_of_all_images_is_refused_and_can_be_brought_back(place):
    with pytest.raises(SarsplatError, match=r"around \(.*\) m, outside of all images.*give `recentre`"):
        outside_images(box(*place), VIEWS, GRID)
    back, moved = recentred(box(*place))
    np.testing.assert_allclose(moved, np.array(place) - (0, 0, 1))
    np.testing.assert_allclose(back.bounds, box().bounds, atol=1e-8)
    assert outside_images(back, VIEWS, GRID) == []


def test_a_mesh_outside_of_some_images_is_said():
    """Below the radar's azimuth it is shifted out of the image, in range it may be shown."""
    away = box(GRID.columns * GRID.spacing_m[0] / 2 + 3.5)
    shown = shown_in(away, VIEWS, GRID)
    assert any(shown) and not all(shown)
    (said,) = outside_images(away, VIEWS, GRID)
    assert f"{shown.count(False)} images of 8 cannot show it" in said


def test_a_mesh_that_is_cut_off_though_it_would_fit_is_said():
    edge = min(GRID.columns * GRID.spacing_m[0], GRID.rows * GRID.spacing_m[1]) / 2
    (said,) = outside_images(box(edge), VIEWS, GRID)
    assert "% of the target's surface is outside of an image, though it would fit" in said
    assert outside_images(box(edge / 2), VIEWS, GRID) == []


def test_coordinates_that_lost_their_digits_are_said():
    assert lost_digits(box(5e5 + 0.3, 5.2e6), GRID) == []  # float64
    rounded = box(5e5 + 0.3, 5.2e6)
    rounded.vertices = rounded.vertices.astype(np.float32).astype(np.float64)
    (said,) = lost_digits(rounded, GRID)
    assert "multiples of 0.5 m" in said


@pytest.mark.parametrize(("z", "share"), [(0, 0.5), (-5, 1.0), (0.75, 0.25)])
def test_what_is_below_the_ground_is_said_with_how_much(z, share):
    (said,) = below_ground(box(z=z), GRID, None)
    shown = float(said.partition("%")[0]) / 100
    sides, bottom = 2 * (6 + 3) * max(0, min(2, 1 - z)), 18 + 18 * (z < -1)
    assert shown == pytest.approx((sides + bottom) / 72, abs=0.006)
    assert f"up to {1 - z:.3g} m" in said and "y is up" not in said


def test_wheels_may_sink_in_and_houses_have_foundations():
    assert below_ground(box(z=1 - 0.4 * max(GRID.resolution_m)), GRID, None) == []
    slope = Terrain(np.array([[0.0, 0.0], [0.0, 0.0]]) + np.array([[-0.4, 0.4]]), (6.0, 6.0))
    assert below_ground(box(), GRID, slope) == []
    assert "100% of the target" in below_ground(box(z=-5), GRID, slope)[0]


def test_a_mesh_that_lies_on_its_side_is_told_from_one_that_is_too_low():
    lying = trimesh.creation.box((6, 2, 3)).apply_translation((0, 1, 0))
    (said,) = below_ground(lying, GRID, None)
    assert "50% of the target" in said and "if y is up in the file, export it with z up" in said


@pytest.mark.parametrize("simulated", ["raycast", "splat", "stack", "one"])
def test_python_warns_of_what_is_below_the_ground_as_the_command_line_does(simulated):
    grid = replace(GRID, rows=24, columns=24, spacing_m=(0.5, 0.5), resolution_m=(0.5, 0.5))

    def simulate(mesh, ground):
        one = mesh, VIEWS[0], grid
        if simulated == "stack":
            simulate_stack(*one, Stack(0.031, (0.0, 0.0004)), ScatteringLaw(), ground_gamma0=ground)
        elif simulated == "one":
            simulate_raycast(*one, ScatteringLaw(), ground_gamma0=ground)
        else:
            simulate_images(mesh, VIEWS[:2], grid, source=simulated, ground_gamma0=ground)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        simulate(box(z=0), 0.1)
    assert {one.category for one in caught} == {SarsplatWarning}
    (said,) = {str(one.message) for one in caught}
    assert "50% of the target's surface is below the ground, up to 1 m" in said
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulate(box(z=0), None)  # there is no ground that could hide it
        simulate(box(z=1), 0.1)
