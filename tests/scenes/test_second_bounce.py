"""Second bounces of the ray caster: closed forms, a sum over pairs, and the renderer's bounce off the ground."""

import json
import math

import numpy as np
import pytest

from sarsplat import ImageGrid, ScatteringLaw, View, simulate_raycast
from sarsplat.scenes._shapes import box
from sarsplat.scenes.raycast import RayCaster
from sarsplat.scenes.simulate import simulate_images, simulation_record

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

CONSTANT, LOBED = ScatteringLaw(1.0, 0.0), ScatteringLaw(0.1, 0.9, 8.0)
GRID = ImageGrid(64, 64, (0.15, 0.15), (0.3, 0.3))  # at resolution = spacing the pixel lattice would ripple
PIXEL = 0.15**2


def second(mesh, view, law=LOBED, grid=GRID, reflectivity=None, **settings):
    """What second bounces add to an image."""
    known = {"law": law, "ground_gamma0": None if reflectivity is None else 0.0, **settings}
    both = simulate_raycast(mesh, view, grid, **known, bounces=2, ground_reflectivity=reflectivity)
    return both.astype(np.float64) - simulate_raycast(mesh, view, grid, **known)


# ---- by way of the ground --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("grazing", [17.0, 45.0, 70.0])
@pytest.mark.parametrize("turned", [0.0, 30.0])
def test_a_wall_returns_at_its_foot(grazing, turned):
    """σ₂ = 4|Γ|²·γ(n·h)·W·H·cos θ·(n·h), n·h the cosine of the level angle between the wall and the radar."""
    wall, view = box((-1, 0), (-2, 2), (0, 1.5)), View(turned, grazing)
    image = second(wall, view, reflectivity=0.5)
    level = math.cos(math.radians(turned))
    section = LOBED.gamma0(np.array([level])).item() * 4 * 1.5 * math.cos(math.radians(grazing)) * level
    if turned:  # and the narrow side of the box
        side = math.sin(math.radians(turned))
        section += LOBED.gamma0(np.array([side])).item() * 1 * 1.5 * math.cos(math.radians(grazing)) * side
    assert image.sum() * PIXEL == pytest.approx(4 * 0.5 * section, rel=2e-3)
    if not turned:
        profile = image.sum(axis=1) / image.sum()
        middle = profile @ GRID.range_m
        assert middle == pytest.approx(0.0, abs=1e-3)  # however high it is, a line
        width = math.sqrt(profile @ (GRID.range_m - middle) ** 2)
        assert width == pytest.approx(math.sqrt(GRID.response_variance_m2[1]), rel=0.01)


def test_a_point_above_the_ground_is_imaged_at_its_foot():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.005).apply_translation((1.0, -0.6, 1.3))
    view = View(40, 35)
    image = second(ball, view, CONSTANT, reflectivity=1.0, ray_spacing=0.0003)
    foot = view.look.frame[[0, 2], :2] @ (1.0, -0.6)
    found = (image.sum(axis=0) @ GRID.azimuth_m) / image.sum(), (image.sum(axis=1) @ GRID.range_m) / image.sum()
    np.testing.assert_allclose(found, foot, atol=5e-3)  # its front is nearer


def test_what_hides_a_leg_takes_the_return_away():
    wall = box((-1, 0), (-2, 2), (0, 1.0))
    free = second(wall, View(0, 45), reflectivity=1.0).sum()
    # a low wall in front: it hides no wall from the radar, but every way by the ground
    low = trimesh.util.concatenate([wall, box((0.5, 0.6), (-3, 3), (0, 0.5))])
    foot = GRID.range_m < -0.2  # of the low wall itself
    assert second(low, View(0, 45), reflectivity=1.0)[~foot].sum() < 0.02 * free
    # one that stands behind, or a roof, changes nothing
    behind = trimesh.util.concatenate([wall, box((-3, -2), (-2, 2), (0, 0.5))])
    assert second(behind, View(0, 45), reflectivity=1.0).sum() == pytest.approx(free, rel=0.02)


def test_both_sides_of_a_plate_do_not_return_together():
    """The radar sees the top of an awning, the ground its bottom."""
    awning = box((-1, 1), (-1, 1), (1.0, 1.01))
    image = second(awning, View(0, 45), CONSTANT, reflectivity=1.0)
    edge = 2 * 0.01 * math.cos(math.radians(45))
    assert image.sum() * PIXEL == pytest.approx(4 * edge, rel=0.05)


@pytest.mark.filterwarnings("ignore:.*of the target's surface is below the ground")
def test_what_lies_below_the_ground_returns_nothing():
    boxes = (box((-1, 0), (-2, 2), (low, 1.0)) for low in (-2, 0))
    buried, standing = (second(mesh, View(20, 40), reflectivity=1.0) for mesh in boxes)
    np.testing.assert_allclose(buried, standing, atol=1e-2)


# ---- between facets --------------------------------------------------------------------------------------------------
def _plates():
    """Two plates that see each other and the radar, in full."""
    floor = np.array([[0.2, -0.5, 0], [1.2, -0.5, 0], [1.2, 0.5, 0], [0.2, 0.5, 0]], dtype=float)
    back = np.array([[-0.3, -0.5, 0.3], [-0.3, 0.5, 0.3], [-0.5, 0.5, 1.2], [-0.5, -0.5, 1.2]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return trimesh.Trimesh(np.concatenate([floor, back]), np.concatenate([faces, faces + 4]), process=False)


@pytest.mark.parametrize("law", [CONSTANT, LOBED])
def test_two_plates_return_the_sum_over_all_pairs_of_places(law):
    mesh, view = _plates(), View(10, 40)
    grid = ImageGrid(96, 96, (0.1, 0.1), (0.3, 0.3))
    image = second(mesh, view, law, grid, ray_spacing=0.01)
    u, frame = view.direction, view.look.frame
    share = (np.arange(24) + 0.5) / 24
    places, normals, areas = [], [], []
    for a, b, _, d in mesh.vertices.reshape(2, 4, 3):
        across, along = b - a, d - a
        places.append((a + share[:, None, None] * across + share[None, :, None] * along).reshape(-1, 3))
        normal = np.cross(across, along)
        areas.append(np.linalg.norm(normal) / 24**2)
        normals.append(normal / np.linalg.norm(normal))
    normals = [n * np.sign(n @ u) for n in normals]
    between = places[1][None] - places[0][:, None]
    length = np.linalg.norm(between, axis=-1)
    away = between / length[..., None]
    cosines = normals[0] @ u, away @ normals[0], -away @ normals[1], normals[1] @ u
    assert min(float(np.min(c)) for c in cosines) > 0
    both = [(u + away) @ normals[0] / np.linalg.norm(u + away, axis=-1)]
    both.append((u - away) @ normals[1] / np.linalg.norm(u - away, axis=-1))
    one = law.gamma0(both[0]) * law.gamma0(both[1]) * areas[0] * areas[1]
    one = one * np.sqrt(np.prod(np.broadcast_arrays(*cosines), 0))
    section = 4 * one / (4 * math.pi * length**2)  # both orders in phase
    assert image.sum() * grid.spacing_m[0] * grid.spacing_m[1] == pytest.approx(section.sum(), rel=0.01)
    slant = (frame[2] @ (places[0][:, None] + places[1][None]).transpose(0, 2, 1) + length) / 2
    expected = (section * slant).sum() / section.sum()
    assert (image.sum(axis=1) @ grid.range_m) / image.sum() == pytest.approx(expected, abs=3e-3)


def test_a_convex_body_returns_nothing_to_itself():
    assert np.abs(second(box((-1, 1), (-1, 1), (0, 1)), View(20, 40))).max() < 1e-5


# ---- the same without, the same bits, and against the renderer -------------------------------------------------------
def test_second_bounces_are_the_same_bits_for_any_number_of_threads(threads):
    mesh, views = _plates(), [View(10, 40), View(-20, 60)]
    known = {"law": LOBED, "ground_gamma0": 0.1, "bounces": 2, "ground_reflectivity": 0.7}
    found = []
    for count in (1, 2):
        threads(count)
        found.append(simulate_images(mesh, views, GRID, **known))
    np.testing.assert_array_equal(*found)


def test_power_is_told_by_the_way_it_returned_and_the_renderer_has_the_same_by_the_ground():
    mesh, views = box((-2, 2), (-1, 1), (0, 1.5)), [View(127.0, 17.0), View(20, 30)]
    known = {"law": LOBED, "ground_gamma0": 0.1}
    added, shares = [], []
    for source in ("raycast", "splat"):
        told: dict[str, float] = {}
        settings = {"source": source, "bounces": 2, "ground_reflectivity": 1.0, "power_by_echo": told}
        both = simulate_images(mesh, views, GRID, **known, **settings)
        added.append(both - simulate_images(mesh, views, GRID, **known, source=source))
        assert sum(told.values()) == pytest.approx(1)
        assert told["by way of the ground"] == pytest.approx(added[-1].sum() / both.sum(), rel=1e-3)
        shares.append(told)
    assert added[1].sum() == pytest.approx(added[0].sum(), rel=0.05)
    assert np.corrcoef(added[0].ravel(), added[1].ravel())[0, 1] > 0.995
    assert [*shares[0]] == ["target", "ground", "by way of the ground", "between facets"]
    assert [*shares[1]] == ["target", "ground", "by way of the ground"]
    assert shares[1] == pytest.approx({kind: shares[0][kind] for kind in shares[1]}, rel=0.05)
    nothing: dict[str, float] = {}
    simulate_images(mesh, views[:1], GRID, **known, power_by_echo=nothing)
    assert not nothing


def test_progress_reaches_the_end_and_never_goes_back():
    told, settings = [], {"reflectivity": None, "ground_gamma0": 0.1, "ray_spacing": 0.02}
    RayCaster(_plates(), GRID, LOBED, **settings, bounces=2, ground_reflectivity=1.0).image(View(10, 40), told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


# ---- records ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("source", ["raycast", "splat"])
def test_the_record_is_json_and_says_the_law_and_second_bounces(source):
    known = {"source": source, "law": LOBED, "ground_gamma0": 0.1, "ray_spacing": 0.02, "seed": 3}
    assert "bounces" not in simulation_record(**known)
    record = simulation_record(**known, bounces=2, ground_reflectivity=0.5)
    assert json.loads(json.dumps(record)) == record
    assert ScatteringLaw(**record["law"]) == LOBED
    assert (record["kind"], record["seed"], record["bounces"], record["ground_reflectivity"]) == (source, 3, 2, 0.5)
