"""Built-in vehicles have their originals' dimensions and consist of closed bodies; so does SLICY."""

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.scenes import VEHICLES, target_mesh, village

pytest.importorskip("trimesh")

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
def test_overall_dimensions_and_centre(meshes, name):
    low, high = meshes[name].bounds
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    assert high - low == pytest.approx(DIMENSIONS[name], abs=0.02)
    if name == "t72":  # without the gun and the drums, which stand out
        below = meshes[name].vertices[meshes[name].vertices[:, 2] < 1.3]
        low, high = below.min(axis=0), below.max(axis=0)
    assert (low + high)[:2] / 2 == pytest.approx((0, 0), abs=0.03)


@pytest.mark.parametrize("name", VEHICLES)
def test_bodies_are_closed_and_face_outwards(meshes, bodies, name):
    assert meshes[name].is_watertight
    assert meshes[name].is_winding_consistent
    assert len(bodies[name]) > 40
    assert min(body.volume for body in bodies[name]) > 0


@pytest.mark.parametrize("name", VEHICLES)
def test_stands_only_on_its_wheels_or_tracks_half_of_them_on_either_side(bodies, name):
    standing = [body for body in bodies[name] if body.bounds[0, 2] < 0.01]
    assert len(standing) == ON_THE_GROUND[name]
    assert sum(body.bounds[0, 1] > 0 for body in standing) == len(standing) / 2
    assert sum(body.bounds[1, 1] < 0 for body in standing) == len(standing) / 2


@pytest.mark.parametrize("name", VEHICLES)
def test_running_gear_is_the_same_on_both_sides(bodies, name):
    gear = np.concatenate([body.vertices for body in bodies[name] if body.bounds[0, 2] < 0.06])
    left, right = gear[gear[:, 1] > 0], gear[gear[:, 1] < 0]
    assert len(left) == len(right) > 300
    for axis in (0, 2):
        assert np.sort(left[:, axis]) == pytest.approx(np.sort(right[:, axis]))
    assert np.sort(left[:, 1]) == pytest.approx(np.sort(-right[:, 1]))


def axles(bodies, height, radius, side):
    """Sorted x of the wheels of this radius with axles at this height, on one side."""
    boxes = [(*body.bounds.mean(axis=0), np.ptp(body.bounds[:, 0])) for body in bodies]
    size = pytest.approx((height, 2 * radius))
    return sorted(x for x, y, z, length in boxes if (z, length) == size and y * side > 0)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("name", "height", "radius", "gaps"),
    [
        ("btr70", 0.56, 0.56, (1.37, 1.65, 1.38)),  # wheelbase 4.4 m, the widest gap in the middle
        ("2s1", 0.375, 0.335, (0.79,) * 6),
        ("kraz", 0.65, 0.65, (1.4, 4.6)),  # a bogie behind
    ],
)
def test_wheels_have_the_gaps_of_the_original(bodies, name, height, radius, gaps, side):
    assert np.diff(axles(bodies[name], height, radius, side)) == pytest.approx(gaps, abs=0.01)


# ---- SLICY -----------------------------------------------------------------------------------------------------------
def test_slicy_has_its_size_and_place(meshes):
    np.testing.assert_allclose(meshes["slicy"].bounds, [[-1.2225, -1.375, 0], [1.2225, 1.375, 1.689]])


def test_a_tall_closed_cylinder_a_short_open_one_and_a_corner_stand_on_the_roof(meshes):
    slicy = meshes["slicy"]

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
    small, large = village(60.0, 3), village(120.0, 3)
    assert large.extents[:2] == pytest.approx((120, 120), abs=20)
    assert small.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    assert large.body_count > 2 * small.body_count
    assert np.array_equal(small.vertices, village(60.0, 3).vertices)
    assert not np.array_equal(small.vertices[:9], village(60.0, 4).vertices[:9])
    assert np.array_equal(target_mesh("village").vertices, village().vertices)
    with pytest.raises(SarsplatError, match="side_m is -1, "):
        village(-1.0)
