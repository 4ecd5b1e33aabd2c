"""Angles as people type them."""

import pytest

from sarsplat.cli.arguments import angles, views_from
from sarsplat.errors import SarsplatError, SarsplatWarning


@pytest.mark.parametrize(
    ("words", "degrees"),
    [
        (["30"], [30]),
        (["-7.5", "10"], [-7.5, 10]),
        (["0:360:90"], [0, 90, 180, 270]),
        (["10:0:-5", "3"], [10, 5, 3]),
        (["0:0.3:0.1"], [0, 0.1, 0.2]),  # rounding adds no angle at the stop
        (["0:1:0.4"], [0, 0.4, 0.8]),
    ],
)
def test_angles(words: list[str], degrees: list[float]) -> None:
    assert angles(words, "azimuth") == pytest.approx(degrees)


@pytest.mark.parametrize("word", ["east", "1:2", "0:10:0", "0:10:-1", "0:inf:1", "0:1:1e-9", "", "1:2:3:4"])
def test_what_is_no_angle_is_named(word: str) -> None:
    with pytest.raises(SarsplatError, match="--azimuth"):
        angles([word], "azimuth")


def test_every_azimuth_at_every_elevation_once() -> None:
    views = views_from(["0", "90", "0:180:90"], [], ["15", "75"])
    assert [(view.azimuth_deg, view.grazing_deg) for view in views] == [(0, 75), (90, 75), (0, 15), (90, 15)]


@pytest.mark.parametrize("word", ["1e308", "-4000", "0:1e308:1e305"])
def test_azimuths_beyond_ten_turns_are_refused(word: str) -> None:
    with pytest.raises(SarsplatError, match="not a number of degrees between ±3600"):
        views_from([word], ["30"], [])


def test_radians_are_told() -> None:
    with pytest.warns(SarsplatWarning, match="look like radians; if they are, multiply"):
        assert len(views_from(["0:6.28:0.26"], [], ["0.26", "0.78"])) == 50
    assert len(views_from(["0:3:1"], ["17"], [])) == 3  # honest: told nothing
