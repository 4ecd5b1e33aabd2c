"""What follows from the direction of a view, by checks that know only the frame's definition; rotations aloft."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.geometry import Look, Turn, View, radar_frame
from sarsplat.geometry.turn import turned

CHANCE = np.random.default_rng(0)
VIEWS = [View(azimuth, grazing) for azimuth in (-630, -90, 0, 180, 720) for grazing in (0.5, 45.0, 89.5)]
VIEWS += [View(*angles) for angles in CHANCE.uniform((0, 2), (360, 88), (10, 2))]
LOOKS = pytest.mark.parametrize("look", [view.look for view in VIEWS], ids=map(str, range(len(VIEWS))))
TILTED = [
    View(azimuth, grazing, tilt, "left" if k % 3 == 0 else "right")
    for k, (azimuth, grazing, tilt) in enumerate(CHANCE.uniform((0, 5, -70), (360, 80, 70), (9, 3)))
]
TILTED += [View(200.0, 35.0, side="left"), View(20.0, 30.0, 1e-6)]
ALL = [view.look for view in VIEWS + TILTED]
ALL_LOOKS = pytest.mark.parametrize("look", ALL, ids=map(str, range(len(ALL))))


def to_radar(azimuth_deg: float, grazing_deg: float) -> np.ndarray:
    """Azimuths run clockwise seen from above, from +x."""
    phi, theta = math.radians(azimuth_deg), math.radians(grazing_deg)
    return np.array([math.cos(theta) * math.cos(phi), -math.cos(theta) * math.sin(phi), math.sin(theta)])


def seen(look: Look, place: np.ndarray) -> np.ndarray:
    """Azimuth, elevation and slant range of a place."""
    return look.frame @ place


def ground_at(look: Look, azimuth: float, slant_range: float, height: float) -> np.ndarray:
    """The place of a height that an image shows there, found by solving for it."""
    matrix = np.stack([look.frame[0], look.frame[2], [0.0, 0.0, 1.0]])
    return np.linalg.solve(matrix, [azimuth, slant_range, height])


@pytest.mark.parametrize("view", VIEWS + TILTED, ids=str)
def test_the_frame_is_orthonormal_and_tilted_about_the_line_of_sight(view):
    level, look = View(view.azimuth_deg, view.grazing_deg).look, view.look
    assert look.frame @ look.frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert (look.frame[2] == level.frame[2]).all()
    mirrored = -1 if view.side == "left" else 1
    assert np.linalg.det(look.frame) == pytest.approx(mirrored)
    assert look.frame[0] @ level.frame[0] == pytest.approx(mirrored * math.cos(math.radians(view.tilt_deg)))
    assert look.frame[0] @ level.frame[1] == pytest.approx(math.sin(math.radians(view.tilt_deg)))  # it rises
    assert look.level == (look.frame[0, 2] == 0.0) == (view.tilt_deg == 0)


def test_left_is_right_mirrored():
    right, left = View(70.0, 40.0, 12.0).look.frame, View(70.0, 40.0, -12.0, "left").look.frame
    assert (left[0] == -right[0]).all() and (left[1:] == right[1:]).all()
    flight, _, away = View(70.0, 40.0, side="left").look.frame
    assert np.cross(flight, away)[2] > 0  # the scene lies to the left of the direction of flight


@ALL_LOOKS
def test_extents_of_the_ground_that_an_image_shows(look):
    to_image = look.gradients[:, :2]
    around = 2 * np.pi * np.arange(720) / 720
    disc = look.disc_m(4.0, 3.0) * np.stack([np.cos(around), np.sin(around)])
    assert np.max(np.abs(to_image @ disc) / [[4.0], [3.0]]) == pytest.approx(1.0, abs=1e-4)
    corners = np.linalg.solve(to_image, [[4.0, 4.0], [3.0, -3.0]])
    assert look.corner_m(4.0, 3.0) == pytest.approx(np.linalg.norm(corners, axis=0).max())


@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_the_direction_leads_to_the_radar(view):
    towards = to_radar(view.azimuth_deg, view.grazing_deg)
    assert view.direction == pytest.approx(towards, abs=1e-12)
    assert view.incidence_deg == pytest.approx(90 - view.grazing_deg)
    assert (radar_frame(view) == view.look.frame).all()


def test_gradients_are_those_of_the_distance_and_of_the_place_along_the_flight():
    """By finite differences of what a radar far away measures, not of the frame."""
    far, step, view = 1e9, 50.0, View(35.0, 40.0)
    towards, flight = to_radar(35.0, 40.0), to_radar(35.0 + 90.0, 1e-9)  # clockwise: the scene is on its right
    antenna = far * towards

    def measured(place: np.ndarray) -> np.ndarray:
        return np.array([place @ flight, np.linalg.norm(antenna - place) - far])

    steps = np.concatenate([step * np.eye(3), -step * np.eye(3)])
    values = np.array([measured(place) for place in steps])
    numerical = (values[:3] - values[3:]).T / (2 * step)
    assert view.look.gradients == pytest.approx(numerical, abs=1e-6)
    assert (view.look.gradients == view.look.frame[[0, 2]]).all()


@ALL_LOOKS
def test_height_is_nearer_and_elevation_is_high(look):
    assert seen(look, np.array([0, 0, 2.0]))[2] == pytest.approx(-2 * look.sine)
    assert (look.frame.T @ [0, 3.0, 0])[2] == pytest.approx(3 * look.height_per_elevation)
    assert (look.frame.T @ [3.0, 0, 0])[2] == pytest.approx(3 * look.height_per_azimuth)
    place = np.linalg.solve(look.gradients[:, :2], look.gradients @ [0.0, 0.0, 2.0])  # where the ground has this image
    assert 2 * look.displaced == pytest.approx(place)
    assert look.height_per_elevation > 0


@ALL_LOOKS
def test_ground_is_where_the_image_shows_it(look):
    for azimuth, slant_range, height in CHANCE.uniform(-9, 9, (5, 3)):
        ground = ground_at(look, azimuth, slant_range, 0.0)
        assert azimuth * look.onto_ground[0] + slant_range * look.onto_ground[1] == pytest.approx(ground[:2])
        assert look.elevation_on_ground(azimuth, slant_range) == pytest.approx(seen(look, ground)[1])
        assert look.range_on_ground(azimuth, seen(look, ground)[1]) == pytest.approx(slant_range)
        place = ground_at(look, azimuth, slant_range, height)
        assert look.elevation_at(azimuth, slant_range, height) == pytest.approx(seen(look, place)[1])
        assert look.ground_range(slant_range, height) == pytest.approx(place[:2] @ look.ahead)
        assert look.slant_range(place[:2] @ look.ahead, height) == pytest.approx(slant_range)


@LOOKS
def test_rays_of_a_column_lie_in_a_vertical_plane_and_end_on_the_ground_in_even_steps(look):
    first, step = look.rows_on_ground(-2.0, 0.3, 0.7)
    for row in range(4):
        place = ground_at(look, 1.0, first + row * step, 0.7)
        assert seen(look, place)[1] == pytest.approx(-2.0 + row * 0.3)
    along, height = 4.0, 1.5
    place = np.append(along * look.ahead, height)
    elevation, slant_range = look.in_section(along, height)
    assert seen(look, place) == pytest.approx([0.0, elevation, slant_range], abs=1e-9)
    assert look.along_ray(elevation, height) == pytest.approx(along)


@ALL_LOOKS
def test_a_shadow_ends_where_the_ray_over_the_top_meets_the_ground(look):
    top = np.array([1.0, -2.0, 1.3])
    end = top + top[2] / look.facing[2] * -look.facing
    assert end[2] == pytest.approx(0.0, abs=1e-9)
    assert top[:2] + look.shadow_m(1.3) * look.ahead == pytest.approx(end[:2])
    assert np.linalg.norm(look.ahead) == pytest.approx(1.0)
    assert look.ahead @ look.facing[:2] < 0  # away from the radar


@ALL_LOOKS
def test_rays_to_the_ground_are_all_and_no_more(look):
    azimuths, ranges, heights = (-3.0, 2.0), (-1.0, 4.0), (-0.5, 2.5)
    (left, right), (low, high) = look.rays_to_ground(azimuths, ranges, heights)
    shown = [
        seen(look, ground_at(look, a, r, z))[:2]
        for a in np.linspace(*azimuths, 3)
        for r in np.linspace(*ranges, 5)
        for z in np.linspace(*heights, 5)
    ]
    assert np.min(shown, axis=0) == pytest.approx([left, low])
    assert np.max(shown, axis=0) == pytest.approx([right, high])


@ALL_LOOKS
def test_level_ground_keeps_its_power_from_the_ground_to_the_image(look):
    """γ⁰ is for each area across the line of sight, β⁰ for each area of the image: of a patch, both give its power."""
    patch = np.stack([np.append(axis, 0.0) for axis in look.onto_ground])  # of 1 m² of the image
    across = abs(np.cross(*patch) @ look.facing)
    assert look.beta0_of_gamma0(0.2) == pytest.approx(0.2 * across)
    assert look.gamma0_of_beta0(look.beta0_of_gamma0(0.2)) == pytest.approx(0.2)


# ---- rotations of a target aloft, also where axis and rate were not what was assumed ---------------------------------
SIGHT = np.array([0.8, 0.5, -0.3])
ASSUMED = (0.2, -0.4, 1.5)
RANDOM = np.random.default_rng(5)


def test_vectors_turn_counter_clockwise_seen_from_the_tip_and_the_line_of_sight_the_other_way() -> None:
    """A turntable that turns counter-clockwise by 30° is seen from 30° of azimuth, which is clockwise."""
    assert turned(np.array([1.0, 0, 0]), (0, 0, 2), 90.0) == pytest.approx([0, 1, 0], abs=1e-12)
    assert turned(np.array([1.0, 2, 3]), (1, 1e200, 0), 360.0) == pytest.approx([1, 2, 3])
    view = Turn((0, 0, 1), 30.0).seen_from(View(10.0, 20.0).direction)
    assert (view.azimuth_deg, view.grazing_deg, view.side) == (pytest.approx(40.0), pytest.approx(20.0), "right")


def check_measured(view: View, sight: np.ndarray, axis: np.ndarray, rate: float, time: float, sine: float) -> None:
    """Azimuth and range against distance and Doppler, from a radar far away, of places on a target that turns."""
    far, step = 1e7, 1e-4
    antenna = far * sight / np.linalg.norm(sight)
    for place in RANDOM.uniform(-3, 3, (4, 3)):
        azimuth, slant_range = view.look.gradients @ place
        before, after = (
            np.linalg.norm(antenna - turned(place, axis, math.degrees(rate * at))) - far for at in (time, time + step)
        )
        assert slant_range == pytest.approx(before, abs=1e-4)
        assert azimuth == pytest.approx((before - after) / step / sine, abs=1e-3)  # the nearer, the higher its Doppler


def sine_between(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(one, other)) / np.linalg.norm(one) / np.linalg.norm(other))


@pytest.mark.parametrize(
    ("sight", "axis"), [((1, 0, 0.5), (0, 0, 1)), ((1, -2, -3), (1, 0.2, 0)), ((0, 1, 0), (0.3, 1, -2))]
)
def test_cross_range_of_inverse_sar_is_the_doppler_of_a_turning_target(sight, axis) -> None:
    sight, axis = np.array(sight, float), np.array(axis, float)
    view = View.isar(sight, axis)
    assert view.aloft and view.direction == pytest.approx(sight / np.linalg.norm(sight), abs=1e-9)
    check_measured(view, sight, axis, 1.0, 0.0, sine_between(sight, axis))


@pytest.mark.parametrize("time", [0.0, 0.7, 2.5, 6.1])
@pytest.mark.parametrize(("tilts_deg", "faster"), [((0.0, 0.0), 0.0), ((0.0, 0.0), 0.04), ((3.0, -2.0), -0.03)])
def test_corrected_views_show_what_was_measured(time: float, tilts_deg: tuple[float, float], faster: float) -> None:
    """One radian a second was assumed, about an axis that is not the true one."""
    turn = Turn(ASSUMED, math.degrees(time))
    assumed = turn.seen_from(SIGHT)
    view = turn.corrected(assumed, tilts_deg, faster)
    start = Turn(ASSUMED, 0.0)
    true_axis = true_axis_of(start.corrected(start.seen_from(SIGHT), tilts_deg, faster), tilts_deg)
    check_measured(view, SIGHT, true_axis, 1 + faster, time, sine_between(SIGHT, np.array(ASSUMED)))
    if not any(tilts_deg) and not faster:
        assert view.look.gradients == pytest.approx(assumed.look.gradients, abs=1e-9)


def true_axis_of(first: View, tilts_deg: tuple[float, float]) -> np.ndarray:
    """The axis that is so many degrees away from the assumed one and across which the first frame has its azimuth."""
    unit = np.array(ASSUMED) / np.linalg.norm(ASSUMED)
    if not any(tilts_deg):
        return unit
    across = np.cross(np.eye(3)[np.abs(unit).argmin()], unit)
    across /= np.linalg.norm(across)
    tilt = tilts_deg[0] * across + tilts_deg[1] * np.cross(unit, across)
    axis = turned(unit, tilt, float(np.linalg.norm(tilt)))
    assert math.degrees(math.acos(axis @ unit)) == pytest.approx(math.hypot(*tilts_deg))
    assert axis @ first.look.frame[0] == pytest.approx(0.0, abs=1e-9)
    return axis


def test_frames_of_one_pass_share_axis_deviations_and_name() -> None:
    turn = Turn(ASSUMED, 10.0, 2.0, 0.01, "a")
    assert replace(turn, angle_deg=50.0).of_pass == turn.of_pass
    for other in ({"name": "b"}, {"axis": (0, 0, 1)}, {"axis_std_deg": 1.0}, {"rate_std": 0.0}):
        assert replace(turn, **other).of_pass != turn.of_pass
    assert turn.uncertain and not Turn(ASSUMED, 10.0).uncertain


@pytest.mark.parametrize("view", [View(10.0, 20.0), View.isar(SIGHT, (0, 0, 1)), View.isar(SIGHT, -np.array(ASSUMED))])
def test_a_view_of_another_rotation_is_refused(view: View) -> None:
    Turn(ASSUMED, 40.0).check(Turn(ASSUMED, 40.0).seen_from(SIGHT))
    with pytest.raises(SarsplatError, match="is not of a target that turns about"):
        Turn(ASSUMED, 40.0).check(view)


def test_a_stretched_view_says_so() -> None:
    view = View(10.0, -20.0, 5.0, aloft=True, stretch=1.04)
    assert view.unusual == ", tilted by 5°, stretched by 1.040"
    assert view.look.gradients == pytest.approx(replace(view, stretch=1.0).look.gradients * np.array([[1.04], [1.0]]))
    place = RANDOM.uniform(-3, 3, 3)
    across, _, away = view.look.frame @ place
    assert view.look.in_frame(*(view.look.gradients @ place)) == pytest.approx((across, away))
