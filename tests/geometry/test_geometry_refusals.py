"""What is refused of directions, places, views, grids, stacks and rotations."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from refusals import Do, Refusals
from sarsplat import DatasetEntry, ImageGrid, Place, RayGrid, SarsplatError, ScatteringLaw, Stack, Terrain, Turn, View
from sarsplat.samples.encoding import Encoding

TURN, PLACE, OBLONG = Turn((0, 0, 1), 5.0), Place(1.0, 2.0, 3.0), ImageGrid(90, 91, (0.5, 0.5), (0.6, 0.5))
NONE: list[object] = [
    *("abc", None, (1.0, 2.0), [1, [2], 3], ["1", "2", "3"], np.array(["a", "b", "c"])),
    *(np.array([True, True, False]), np.array([1j, 0, 1]), np.array([None, 1, 2]), (0, 0, 0), (np.nan, 0, 1)),
]


DIRECTED = [TURN.seen_from, View.towards, lambda one: View.isar(one, (0, 0, 1)), lambda one: View.isar((1, 0, 0), one)]


@pytest.mark.parametrize("made", [*DIRECTED, lambda one: Turn(one, 1.0), Place.of_ecef])
@pytest.mark.parametrize("none", NONE, ids=str)
def test_what_is_no_direction_is_refused(made: Callable[[object], object], none: object) -> None:
    with pytest.raises(SarsplatError, match=r"has no direction; give three|give a num|make each a"):
        made(none)


def test_numbers_of_any_kind_make_directions() -> None:
    for one in ([1, 0, 1], (1.0, 0, 1), np.array([1.0, 0.0, 1.0])):
        assert View.isar(one, (0, 0, 1)) == View.isar((1.0, 0.0, 1.0), (0, 0, 1))  # type: ignore[arg-type]


@pytest.mark.parametrize("convert", [PLACE.to_ecef, PLACE.from_ecef, PLACE.to_geodetic, PLACE.from_geodetic])
@pytest.mark.parametrize("none", ["abc", None, (1.0, 2.0), np.zeros((3, 2)), ["1", "2", "3"]], ids=str)
def test_what_are_no_places_are_refused(convert: Callable[[object], object], none: object) -> None:
    with pytest.raises(SarsplatError, match="give an array of numbers whose last axis has three"):
        convert(none)


@pytest.mark.parametrize(
    "made",
    [
        lambda: View(True, 30.0),
        lambda: Turn((0, 0, 1), True),
        lambda: Turn((0, 0, 1), 1.0, 0.0, np.True_),  # type: ignore[arg-type]
        lambda: Place(True, 2.0, 3.0),
        lambda: ImageGrid(True, 8, (0.2, 0.2), (0.3, 0.3)),
        lambda: ImageGrid(8, 8, (True, 0.2), (0.3, 0.3)),
        lambda: ImageGrid(8, 8, (0.2, 0.2), (0.3, 0.3), (True, 0.0)),
        lambda: RayGrid((True, 1.0)),
        lambda: Stack(0.03, (False, 0.1)),
        lambda: Terrain(np.ones((3, 3)), (True, 1.0)),
        lambda: DatasetEntry(View(1.0, 30.0), "train", "a", True),
        lambda: ScatteringLaw(True),
        lambda: Encoding(crop=True),
    ],
)
def test_true_and_false_are_no_numbers(made: Callable[[], object]) -> None:
    with pytest.raises(SarsplatError):
        made()


def wrong(kind: Callable[..., object], usual: dict[str, object], words: str, *values: object, **fields: object) -> Any:
    return lambda _: kind(*values, **{**usual, **fields}), words


grid = partial(wrong, ImageGrid, {"rows": 4, "columns": 4, "spacing_m": (0.2, 0.2), "resolution_m": (0.3, 0.3)})
stack = partial(wrong, Stack, {"wavelength_m": 0.03, "offsets_rad": (0.0, 0.001)})
turn = partial(wrong, Turn, {"axis": (0.2, -0.4, 1.5), "angle_deg": 10.0})
place, view = partial(wrong, Place, {}), partial(wrong, View, {})

REFUSED: Refusals = [
    grid(r"pixel spacing \('0.2', 0.2\) must be a pair of metres", spacing_m=("0.2", 0.2)),
    grid("pixel spacing 0.2 must be a pair of metres", spacing_m=0.2),
    grid("pixel spacing .* must be a pair", spacing_m=(0.2, 0.99e-6)),
    grid(r"resolution \(0.1, nan\) must be a pair", resolution_m=(0.1, math.nan)),
    grid("resolution .* 1e-06 to 1e.06", resolution_m=(1.01e6, 0.1)),
    grid(r"image centre \(inf, 0.0\) must be a pair", center_m=(math.inf, 0.0)),
    grid("image centre .* must be a pair of metres", center_m=(0.0, -1.01e6)),
    grid("rows is 4.0; give a whole number", rows=4.0),
    grid("an image of 0 × 4 pixels is empty", rows=0),
    grid("4 × 131073 pixels is empty or too large", columns=131_073),
    (lambda _: OBLONG.multilooked(91), "90 × 91 pixels has no blocks of 91 × 91; give a factor from 1 to 90"),
    (lambda _: RayGrid((0.0, 0.1)), r"ray spacing \(0.0, 0.1\) must be"),
    stack("wavelength_m is 0.0; give 0.0001 to 100 metres", wavelength_m=0.0),
    *(stack("offsets_rad is .*b/R in radians", offsets_rad=bad) for bad in ((), (0.0, 0.3), (0.0, math.nan))),
    stack("transmit is 'both'; give one of 'each', 'one'", transmit="both"),
    *(stack("noise is .*a positive power", noise=bad) for bad in ((0.1,), (0.1, 0.0), (0.1, math.nan))),
    *(stack("polarisations is .*one of HH, HV", polarisations=bad) for bad in (("HH",), ("HH", "XY"))),
    stack("two passes are the same", offsets_rad=(0.0, 0.0)),
    stack("two passes are the same", offsets_rad=(0.0, 0.0), polarisations=("HH", "HH")),
    turn("angle_deg 1000000.0 is not a number between -36000 and 36000", angle_deg=1e6),
    turn("axis_std_deg 11.0 is not a number between 0 and 10; give degrees", axis_std_deg=11.0),
    turn("rate_std -0.1 is not a number between 0 and 0.2", rate_std=-0.1),
    turn("rate_std 'much' is not a number", rate_std="much"),
    turn("name is 3; give a str", name=3),
    place("latitude_deg 91.0 of a place", 91.0, 0.0, 0.0),
    place("longitude_deg 361.0 of", 0.0, 361.0, 0.0),
    place("latitude_deg nan", np.nan, 0.0, 0.0),
    place("height_m 200000.0 of", 0.0, 0.0, 2e5),
    place("x_towards_deg inf", 0.0, 0.0, 0.0, np.inf),
    (lambda _: View.isar((0, 0, 1), (0, 0, 2)), "along the line of sight"),
    view("azimuth is '30'; give a number", "30", 40.0),
    view("grazing angle is None; give a number", 30.0, None),
    *(view("azimuth .* is not a number between", azimuth, 40.0) for azimuth in (1e308, -3600.1, math.nan)),
    *(view(r"grazing angle .*° is outside \(0°, 90°\)", 0.0, bad) for bad in (0.0, 90.0, -1.0, math.nan)),
    view(r"outside \(-90°, 90°\)", 10.0, -90.0, aloft=True),
    view("aloft is 'no'; give True or False", 0, 30, aloft="no"),
    view("only images of a target aloft can be stretched", 10, 20, stretch=1.1),
    *(view("stretch .* is not a number between 0.5 and 2", 10, 20, aloft=True, stretch=bad) for bad in (3.0, math.nan)),
    view("tilt 89.5 is not a number between -89 and 89", 10.0, 5.0, 89.5),
    view("side is 'up'; give one of 'right', 'left'", 10.0, 5.0, side="up"),
]


@pytest.mark.parametrize(("do", "words"), REFUSED)
def test_what_is_refused_in_a_sentence(do: Do, words: str) -> None:
    with pytest.raises(SarsplatError, match=words):
        do(None)  # type: ignore[arg-type]
