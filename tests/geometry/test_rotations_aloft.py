"""Rotations of a target aloft: which view a frame has, also where axis and rate were not what was assumed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.geometry import Turn, View
from sarsplat.geometry.turn import turned

SIGHT = np.array([0.8, 0.5, -0.3])
ASSUMED = (0.2, -0.4, 1.5)
CHANCE = np.random.default_rng(5)


def test_vectors_turn_counter_clockwise_seen_from_the_tip() -> None:
    assert turned(np.array([1.0, 0, 0]), (0, 0, 2), 90.0) == pytest.approx([0, 1, 0], abs=1e-12)
    assert turned(np.array([1.0, 2, 3]), (1, 1e200, 0), 360.0) == pytest.approx([1, 2, 3])


def test_the_line_of_sight_turns_the_other_way() -> None:
    """A turntable that turns counter-clockwise by 30° is seen from 30° of azimuth, which is clockwise."""
    view = Turn((0, 0, 1), 30.0).seen_from(View(10.0, 20.0).direction)
    assert (view.azimuth_deg, view.grazing_deg, view.side) == (pytest.approx(40.0), pytest.approx(20.0), "right")


def measured(axis: np.ndarray, rate: float, time: float, place: np.ndarray) -> tuple[float, float]:
    """Slant range and Doppler rate of a place on a target that turns, from a radar far away in a fixed direction."""
    far, step = 1e7, 1e-4
    antenna = far * SIGHT / np.linalg.norm(SIGHT)
    before, after = (
        np.linalg.norm(antenna - turned(place, axis, math.degrees(rate * at))) - far for at in (time, time + step)
    )
    return float(before), float(after - before) / step


@pytest.mark.parametrize("time", [0.0, 0.7, 2.5, 6.1])
@pytest.mark.parametrize(("tilts_deg", "faster"), [((0.0, 0.0), 0.0), ((0.0, 0.0), 0.04), ((3.0, -2.0), -0.03)])
def test_corrected_views_show_what_was_measured_and_scaled_by_what_was_assumed(
    time: float, tilts_deg: tuple[float, float], faster: float
) -> None:
    """One radian a second was assumed, about an axis that is not the true one."""
    turn = Turn(ASSUMED, math.degrees(time))
    assumed = turn.seen_from(SIGHT)
    view = turn.corrected(assumed, tilts_deg, faster)
    start = Turn(ASSUMED, 0.0)
    true_axis = true_axis_of(start.corrected(start.seen_from(SIGHT), tilts_deg, faster), tilts_deg)
    sine = np.linalg.norm(np.cross(SIGHT, ASSUMED)) / np.linalg.norm(SIGHT) / np.linalg.norm(ASSUMED)
    for place in CHANCE.uniform(-3, 3, (4, 3)):
        azimuth, slant_range = view.look.gradients @ place
        distance, rate = measured(true_axis, 1 + faster, time, place)
        assert slant_range == pytest.approx(distance, abs=1e-4)
        assert azimuth == pytest.approx(-rate / sine, abs=1e-3)
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


@pytest.mark.parametrize(
    "view",
    [
        View(10.0, 20.0),
        View.isar(SIGHT, (0, 0, 1)),
        View.isar(SIGHT, -np.array(ASSUMED)),
    ],
)
def test_a_view_of_another_rotation_is_refused(view: View) -> None:
    Turn(ASSUMED, 40.0).check(Turn(ASSUMED, 40.0).seen_from(SIGHT))
    with pytest.raises(SarsplatError, match="is not of a target that turns about"):
        Turn(ASSUMED, 40.0).check(view)


def test_a_stretched_view_says_so() -> None:
    view = View(10.0, -20.0, 5.0, aloft=True, stretch=1.04)
    assert view.unusual == ", tilted by 5°, stretched by 1.040"
    assert view.look.gradients == pytest.approx(replace(view, stretch=1.0).look.gradients * np.array([[1.04], [1.0]]))
    place = CHANCE.uniform(-3, 3, 3)
    across, _, away = view.look.frame @ place
    assert view.look.in_frame(*(view.look.gradients @ place)) == pytest.approx((across, away))


def test_one_pass_leaves_its_axis_open_where_the_target_may_be_stretched() -> None:
    """A target that is longer along the axis and narrower across it is shown alike, nearer to the line of sight.

    Only what hides what, and how surfaces scatter, tells them apart.
    """
    unit, sight = np.array(ASSUMED) / np.linalg.norm(ASSUMED), SIGHT / np.linalg.norm(SIGHT)
    level = np.cross(unit, sight) / np.linalg.norm(np.cross(unit, sight))
    across = np.cross(np.eye(3)[np.abs(unit).argmin()], unit)
    across /= np.linalg.norm(across)
    tilt_deg = 4.0
    tilts_deg = tilt_deg * float(level @ across), tilt_deg * float(level @ np.cross(unit, across))
    axis = turned(unit, level, tilt_deg)  # by so much nearer to the line of sight
    for angle_deg in (0.0, 50.0, 170.0, 300.0):
        turn = Turn(ASSUMED, angle_deg)
        assumed = turn.seen_from(sight)
        true = turn.corrected(assumed, tilts_deg, 0.0)
        for place in CHANCE.uniform(-3, 3, (3, 3)):
            moved = turned(place, level, -tilt_deg)
            along = float(moved @ unit)
            narrower = np.linalg.norm(np.cross(axis, sight)) / np.linalg.norm(np.cross(unit, sight))
            longer = float(axis @ sight) / float(unit @ sight)
            stretched = narrower * (moved - along * unit) + longer * along * unit
            assert assumed.look.gradients @ stretched == pytest.approx(true.look.gradients @ place, abs=1e-9)
