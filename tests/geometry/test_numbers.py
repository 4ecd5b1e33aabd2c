"""What geometry is made of: numbers that are none, and directions and places that have not three, are refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sarsplat import ImageGrid, Place, RayGrid, Stack, Terrain, Turn, View
from sarsplat.data import DatasetEntry
from sarsplat.errors import SarsplatError
from sarsplat.samples.encoding import Encoding
from sarsplat.scenes import ScatteringLaw

TURN, PLACE = Turn((0, 0, 1), 5.0), Place(1.0, 2.0, 3.0)
NONE: list[object] = [
    *("abc", None, (1.0, 2.0), [1, [2], 3], ["a", 1, 2], ["1", "2", "3"], [True, 1, 2], np.array(["a", "b", "c"])),
    *(
        np.array([True, True, False]),
        np.array([1j, 0, 1]),
        np.array([None, 1, 2]),
        (0, 0, 0),
        (np.nan, 0, 1),
        np.eye(3),
    ),
]


@pytest.mark.parametrize(
    "made",
    {
        "seen_from": TURN.seen_from,
        "towards": View.towards,
        "isar": lambda one: View.isar(one, (0, 0, 1)),
        "axis": lambda one: View.isar((1, 0, 0), one),
        "turn": lambda one: Turn(one, 1.0),
        "of_ecef": Place.of_ecef,
    }.values(),
)
@pytest.mark.parametrize("none", NONE, ids=str)
def test_what_is_no_direction_is_refused(made: Callable[[object], object], none: object) -> None:
    with pytest.raises(SarsplatError, match=r"has no direction; give three|give a num|make each a"):
        made(none)


def test_numbers_of_any_kind_make_directions() -> None:
    for one in ([1, 0, 1], (1.0, 0, 1), np.array([1.0, 0.0, 1.0])):
        assert View.isar(one, (0, 0, 1)) == View.isar((1.0, 0.0, 1.0), (0, 0, 1))  # type: ignore[arg-type]


@pytest.mark.parametrize("convert", [PLACE.to_ecef, PLACE.from_ecef, PLACE.to_geodetic, PLACE.from_geodetic, PLACE.enu])
@pytest.mark.parametrize(
    "none", ["abc", None, (1.0, 2.0), [[1, 2], [3, 4]], np.zeros((3, 2)), ["1", "2", "3"]], ids=str
)
def test_what_are_no_places_are_refused(convert: Callable[[object], object], none: object) -> None:
    with pytest.raises(SarsplatError, match="give an array of numbers whose last axis has three"):
        convert(none)


@pytest.mark.parametrize(
    "made",
    {
        "azimuth": lambda: View(True, 30.0),
        "grazing": lambda: View(1.0, True),
        "tilt": lambda: View(1.0, 30.0, True),
        "angle of a turn": lambda: Turn((0, 0, 1), True),
        "rate of a turn": lambda: Turn((0, 0, 1), 1.0, 0.0, np.True_),  # type: ignore[arg-type]
        "latitude": lambda: Place(True, 2.0, 3.0),
        "height": lambda: Place(1.0, 2.0, True),
        "bearing": lambda: PLACE.bearing_deg("a"),  # type: ignore[arg-type]
        "rows": lambda: ImageGrid(True, 8, (0.2, 0.2), (0.3, 0.3)),
        "spacing": lambda: ImageGrid(8, 8, (True, 0.2), (0.3, 0.3)),
        "centre": lambda: ImageGrid(8, 8, (0.2, 0.2), (0.3, 0.3), (True, 0.0)),
        "rays": lambda: RayGrid((True, 1.0)),
        "offset": lambda: Stack(0.03, (False, 0.1)),
        "pitch": lambda: Terrain(np.ones((3, 3)), (True, 1.0)),
        "uncertainty": lambda: DatasetEntry(View(1.0, 30.0), "train", "a", True),
        "law": lambda: ScatteringLaw(True),
        "crop": lambda: Encoding(crop=True),
        "quality": lambda: Encoding(jpeg_quality="a"),  # type: ignore[arg-type]
        "view of a turn": lambda: TURN.check("a"),  # type: ignore[arg-type]
    }.values(),
)
def test_true_and_false_are_no_numbers(made: Callable[[], object]) -> None:
    with pytest.raises(SarsplatError):
        made()
