"""Built-in targets and protocols, and where meshes stand: in their images, and on the ground."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from sarsplat import ImageGrid, SarsplatError, SarsplatWarning, ScatteringLaw, Stack, Terrain, View, simulate_images
from sarsplat.scenes import (
    VEHICLES,
    mstar_grid,
    mstar_views,
    paper_grid,
    paper_views,
    simulate_raycast,
    simulate_stack,
    target_mesh,
    village,
)
from sarsplat.scenes.placement import lost_digits, outside_images, recentred, shown_in, warn_below_ground

trimesh = pytest.importorskip("trimesh")

# Published length, width and height, m. The T-72's length is the one with its gun forward.
DIMENSIONS = {
    "t72": (9.55, 3.60, 2.20),
    "btr70": (7.54, 2.80, 2.24),
    "2s1": (7.26, 2.85, 2.73),
    "kraz": (8.65, 2.75, 2.94),
}
ON_THE_GROUND = {"t72": 2, "btr70": 8, "2s1": 2, "kraz": 6}  # tracks or wheels


@pytest.fixture(scope="module")
def meshes():
    return {name: target_mesh(name) for name in (*VEHICLES, "slicy")}


@pytest.fixture(scope="module")
def bodies(meshes):
    return {name: meshes[name].split(only_watertight=False) for name in VEHICLES}


@pytest.mark.parametrize("name", VEHICLES)
def test_bodies_are_closed_and_face_outwards_with_overall_dimensions_around_the_centre(meshes, bodies, name):
    mesh, parts = meshes[name], bodies[name]
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert len(parts) > 40
    assert min(body.volume for body in parts) > 0
    low, high = mesh.bounds
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    assert high - low == pytest.approx(DIMENSIONS[name], abs=0.02)
    if name == "t72":  # without the gun and the drums, which stand out
        below = mesh.vertices[mesh.vertices[:, 2] < 1.3]
        low, high = below.min(axis=0), below.max(axis=0)
    assert (low + high)[:2] / 2 == pytest.approx((0, 0), abs=0.03)


@pytest.mark.parametrize("name", VEHICLES)
def test_stands_only_on_its_running_gear_which_is_the_same_on_both_sides(bodies, name):
    standing = [body for body in bodies[name] if body.bounds[0, 2] < 0.01]
    assert len(standing) == ON_THE_GROUND[name]
    gear = np.concatenate([body.vertices for body in bodies[name] if body.bounds[0, 2] < 0.06])
    left, right = gear[gear[:, 1] > 0], gear[gear[:, 1] < 0]
    assert len(left) == len(right) > 300
    for axis in (0, 2):
        assert np.sort(left[:, axis]) == pytest.approx(np.sort(right[:, axis]))
    assert np.sort(left[:, 1]) == pytest.approx(np.sort(-right[:, 1]))


@pytest.mark.parametrize(
    ("name", "height", "radius", "gaps"),
    [
        ("btr70", 0.56, 0.56, (1.37, 1.65, 1.38)),  # wheelbase 4.4 m, the widest gap in the middle
        ("2s1", 0.375, 0.335, (0.79,) * 6),
        ("kraz", 0.65, 0.65, (1.4, 4.6)),  # a bogie behind
    ],
)
def test_wheels_have_the_gaps_of_the_original(bodies, name, height, radius, gaps):
    """Along x, on the left side: wheels are the bodies of this diameter with axles at this height."""
    boxes = [(*body.bounds.mean(axis=0), np.ptp(body.bounds[:, 0])) for body in bodies[name]]
    size = pytest.approx((height, 2 * radius))
    axles = sorted(x for x, y, z, length in boxes if (z, length) == size and y > 0)
    assert np.diff(axles) == pytest.approx(gaps, abs=0.01)


# ---- SLICY -----------------------------------------------------------------------------------------------------------
def test_a_tall_closed_cylinder_a_short_open_one_and_a_corner_stand_on_the_roof(meshes):
    slicy = meshes["slicy"]
    np.testing.assert_allclose(slicy.bounds, [[-1.2225, -1.375, 0], [1.2225, 1.375, 1.689]])

    def height(x, y):
        hits, *_ = slicy.ray.intersects_location([[x, y, 5.0]], [[0, 0, -1.0]])
        return hits[:, 2].max()

    assert height(-0.4933, 0.5838) == pytest.approx(1.689)  # closed
    assert height(-0.4933, -0.5821) == pytest.approx(0.774)  # one looks through the tube
    assert slicy.vertices[np.abs(slicy.vertices[:, 2] - 1.232) < 1e-9].shape[0] >= 24  # its rim
    assert height(1.1, -1.0) == pytest.approx(0.4604)  # the step
    assert height(0.9089, 0.3) == pytest.approx(0.774, abs=0.001)  # the lying cylinder is as high as the roof
    assert slicy.vertices[np.abs(slicy.vertices[:, 2] - 1.0667) < 1e-9].shape[0] >= 1  # the corner's third leg


def test_the_corner_opens_towards_the_step(meshes):
    *_, corner = meshes["slicy"].split(only_watertight=False, repair=False)
    assert len(corner.faces) == 3
    normals = corner.face_normals
    np.testing.assert_allclose(np.abs(normals @ normals.T), np.eye(3), atol=1e-6)  # at right angles to each other
    apex = np.array([0.1659, 0.3783, 0.774])
    assert (corner.vertices[:, 0] >= apex[0] - 1e-9).all()
    assert np.linalg.norm(corner.vertices - apex, axis=1) == pytest.approx([0, 0.2927, 0.2927, 0.2927], abs=1e-4)


def test_a_village_is_as_large_as_asked_for_and_drawn_by_its_seed():
    small, large = village(60.0, 3, 4.0), village(120.0, 3, 4.0)
    assert large.extents[:2] == pytest.approx((120, 120), abs=20)
    assert small.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    assert large.body_count > 2 * small.body_count
    assert np.array_equal(small.vertices, village(60.0, 3, 4.0).vertices)
    assert not np.array_equal(small.vertices[:9], village(60.0, 4, 4.0).vertices[:9])
    with pytest.raises(SarsplatError, match="side_m is -1, "):
        village(-1.0)


# ---- where meshes stand ----------------------------------------------------------------------------------------------
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


def test_a_mesh_outside_of_some_images_or_cut_off_though_it_would_fit_is_said():
    """Below the radar's azimuth it is shifted out of the image, in range it may be shown."""
    edge = GRID.columns * GRID.spacing_m[0] / 2
    shown = shown_in(box(edge + 3.5), VIEWS, GRID)
    assert any(shown) and not all(shown)
    (said,) = outside_images(box(edge + 3.5), VIEWS, GRID)
    assert f"{shown.count(False)} images of 8 cannot show it" in said
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


def test_wheels_may_sink_in_houses_have_foundations_and_a_mesh_may_lie_on_its_side():
    lying = trimesh.creation.box((6, 2, 3)).apply_translation((0, 1, 0))
    (said,) = below_ground(lying, GRID, None)
    assert "50% of the target" in said and "if y is up in the file, export it with z up" in said
    assert below_ground(box(z=1 - 0.4 * max(GRID.resolution_m)), GRID, None) == []
    slope = Terrain(np.array([[0.0, 0.0], [0.0, 0.0]]) + np.array([[-0.4, 0.4]]), (6.0, 6.0))
    assert below_ground(box(), GRID, slope) == []
    assert "100% of the target" in below_ground(box(z=-5), GRID, slope)[0]


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


# ---- views and grids of the experiments ------------------------------------------------------------------------------
@pytest.mark.parametrize("views", [paper_views(), mstar_views()])  # tests/data/test_coverage.py lists their groups
def test_azimuths_of_a_protocol_are_trained_on_or_tested(views):
    train = {view.azimuth_deg for view, split in views if split == "train"}
    assert not train & {view.azimuth_deg for view, split in views if split != "train"}
    assert paper_grid() == ImageGrid(128, 128, (0.3, 0.3), (0.3, 0.3))
    assert mstar_grid() == ImageGrid(128, 128, (0.203125, 0.202148), (0.3229, 0.3013))
