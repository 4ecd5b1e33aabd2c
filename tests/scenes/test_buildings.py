"""Boxes and buildings against closed forms: edges, levels and layover by both forward models, and masks."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, View, radar_frame
from sarsplat.scenes import BUILDINGS, Gamma0, ScatteringLaw, building_profile, target_mesh
from sarsplat.scenes.raycast import raycast_mask, raycast_masks
from sarsplat.scenes.simulate import simulate_images

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRID = ImageGrid(144, 20, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))  # as far as building A's shadow at 30°
LAW = ScatteringLaw(floor=1.0, lobe=0.0)  # the same at every angle: the faces' own factor is their γ⁰
EQUAL, UNEQUAL = Gamma0(0.5, 0.5, 0.5), Gamma0(wall=0.8, roof=0.3, ground=0.1)
CASES = [(n, t, g) for n in sorted(BUILDINGS) for t in (30.0, 45.0, 60.0) for g in (EQUAL, UNEQUAL)]


def image_of(source, name, grazing, gamma0):
    short = replace(BUILDINGS[name], length=10.0)  # and still longer than the image is wide
    factors = {"reflectivity": short.reflectivity(gamma0), "ground_gamma0": gamma0.ground}
    return simulate_images(short.mesh(), [View(0.0, grazing)], GRID, source=source, law=LAW, **factors)[0]


def check(source, name, grazing, gamma0, *, edges_px, levels):
    """Every edge within `edges_px` pixels, every region within the fraction `levels` of its analytic β⁰."""
    profile = building_profile(image_of(source, name, grazing, gamma0), GRID, BUILDINGS[name], grazing, gamma0)
    errors = {edge.ground_range: edge.error / GRID.spacing_m[1] for edge in profile.edges}
    assert all(abs(error) <= edges_px for error in errors.values()), errors
    free = gamma0.ground * math.tan(math.radians(grazing))
    measured = [(item.region, item.beta0) for item in profile.regions if item.beta0 is not None]
    assert len(measured) >= 4 or grazing > 45 or name == "building-b"
    for region, beta0 in measured:
        assert beta0 == pytest.approx(region.beta0, rel=levels, abs=0.0 if region.surfaces else levels * free), region


@pytest.mark.parametrize(("name", "grazing", "gamma0"), CASES)
def test_ray_caster(name, grazing, gamma0):
    check("raycast", name, grazing, gamma0, edges_px=0.05, levels=1e-3)


@pytest.mark.parametrize(
    ("name", "grazing", "gamma0"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case != ("building-a", 45.0, UNEQUAL))) for case in CASES],
)
def test_splat_renderer(name, grazing, gamma0):
    check("splat", name, grazing, gamma0, edges_px=0.5, levels=0.01)


# ---- the closed form itself ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "regions"),
    [
        ("building-a", [((-10, -6), "roof wall ground"), ((-6, 0), "wall ground"), ((0, 14), "")]),
        ("building-b", [((-8, 0), "roof wall ground"), ((0, 16), "")]),
        ("building-c", [((-6, 0), "roof wall ground"), ((0, 4), "roof"), ((4, 16), "")]),
    ],
)
def test_the_paper_s_regions_at_45_degrees(name, regions):
    near, *middle, far = BUILDINGS[name].regions(45.0, EQUAL)
    assert (near.start, far.stop) == (-math.inf, math.inf)
    assert near.surfaces == far.surfaces == ("ground",)
    assert [(region.start, region.stop) for region in middle] == [pytest.approx(limits) for limits, _ in regions]
    assert [" ".join(region.surfaces) for region in middle] == [surfaces for _, surfaces in regions]
    assert [region.beta0 for region in middle] == pytest.approx([0.5 * len(s.split()) for _, s in regions])


def test_the_profile_is_the_regions_seen_through_the_response():
    box, cos = BUILDINGS["building-a"], math.cos(math.radians(45.0))
    sharp = box.profile(np.array([-8.0, -3.0, 7.0, 20.0]) * cos, 45.0, EQUAL, 1e-6)
    assert sharp == pytest.approx([1.5, 1.0, 0.0, 0.5])
    # at an edge the mean of both levels; half a 3 dB width beside it, the share erfc(√ln 2)/2 of the step
    step = 0.5 * math.erfc(math.sqrt(math.log(2)))
    beside = box.profile(np.array([0.0, 0.15]), 45.0, EQUAL, 0.3)
    assert beside == pytest.approx([0.5, step])


def test_a_misplaced_or_faint_image_is_measured_as_such():
    name = "building-a"
    image = image_of("raycast", name, 45.0, EQUAL)
    profile = building_profile(np.roll(image, 1, axis=0) * 0.98, GRID, BUILDINGS[name], 45.0, EQUAL)
    assert [edge.error for edge in profile.edges] == pytest.approx([0.3] * 4, abs=0.03)
    lit = [item for item in profile.regions if item.region.surfaces and item.beta0 is not None]
    assert [item.beta0 / item.region.beta0 for item in lit] == pytest.approx([0.98] * len(lit), abs=0.002)


def test_the_near_wall_faces_azimuth_0_with_its_foot_at_the_origin():
    mesh = target_mesh("building-a")
    np.testing.assert_allclose(mesh.bounds, [[-4, -8, 0], [0, 8, 10]])
    assert mesh.is_winding_consistent
    outward = mesh.triangles_center - [-2.0, 0.0, 5.0]
    assert ((outward * mesh.face_normals).sum(axis=1) > 0).all()
    np.testing.assert_array_equal(mesh.face_normals[:, 2] > 0.5, BUILDINGS["building-a"].reflectivity(UNEQUAL) == 0.3)


# ---- masks by ray casting --------------------------------------------------------------------------------------------
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


def test_neither_orientation_nor_resolution_nor_parts_below_the_ground_matter():
    views, counts = [View(25, 17), View(250, 45)], list[int]()
    inverted, blurred = box(LOW - (0, 0, 3), HIGH), ImageGrid(48, 40, (0.3, 0.3), (0.9, 0.6))
    inverted.invert()
    masks = raycast_masks(inverted, views, blurred, progress=counts.append)
    np.testing.assert_array_equal(masks, [raycast_mask(box(), view, GRIDS[0]) for view in views])
    assert counts == [1, 2]
    assert not raycast_mask(box(LOW - (0, 0, 5), HIGH - (0, 0, 5)), View(25, 30), GRIDS[0]).any()
