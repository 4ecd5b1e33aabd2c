"""Buildings A, B and C through both forward models, against the closed form: edges, levels, layover."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes import BUILDINGS, Gamma0, ScatteringLaw, building_profile, target_mesh
from sarsplat.scenes.simulate import simulate_images

pytest.importorskip("trimesh")
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
    [pytest.param(*case, marks=[pytest.mark.slow] * (case[1:] != (45.0, UNEQUAL))) for case in CASES],
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
