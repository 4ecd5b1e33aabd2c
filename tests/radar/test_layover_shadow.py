"""Layover and shadow on a map of heights, against closed forms and a search by brute force."""

import math
import tracemalloc

import numpy as np
import pytest

from sarsplat import SarsplatError, View
from sarsplat.radar.layover_shadow import BOTH, FREE, LAYOVER, SHADOW, UNKNOWN, layover_shadow

PITCH = 0.25
EAST, NORTH, WEST, SOUTH = 0.0, -90.0, 180.0, 90.0
"""Azimuths of a radar there, if x is east."""


def box(height: float = 10.0) -> np.ndarray:
    """Heights of 100 × 100 m with a box of 20 × 20 m in the middle."""
    x = (np.arange(400) - 199.5) * PITCH
    return np.where((abs(x[:, None]) < 10) & (abs(x) < 10), height, 0.0)


@pytest.mark.parametrize("azimuth", [EAST, NORTH, WEST, SOUTH])
@pytest.mark.parametrize("grazing", [30.0, 45.0, 60.0])
def test_a_box_throws_its_shadow_behind_and_lies_over_what_is_before_it(azimuth: float, grazing: float) -> None:
    classes = layover_shadow(box(), (PITCH, PITCH), View(azimuth, grazing))
    turned = {EAST: classes[200, ::-1], WEST: classes[200], NORTH: classes[:, 200], SOUTH: classes[::-1, 200]}
    line = turned[azimuth]  # away from the radar; the box is from 40 to 60 m
    lengths = {value: (line == value).sum() * PITCH for value in (SHADOW, LAYOVER, BOTH)}
    tangent = math.tan(math.radians(grazing))
    # as far before the wall as it is high in range, and as far on the roof; the ramp of a step is a pixel wide
    assert lengths[LAYOVER] == pytest.approx(10 * tangent + min(20, 10 * tangent), abs=2 * PITCH)
    assert lengths[SHADOW] == pytest.approx(10 / tangent, abs=2 * PITCH)
    assert lengths[BOTH] <= PITCH
    (shadow,), (layover,) = np.nonzero(line == SHADOW), np.nonzero(line == LAYOVER)
    assert shadow[0] * PITCH == pytest.approx(60, abs=2 * PITCH)
    assert layover[0] * PITCH == pytest.approx(40 - 10 * tangent, abs=2 * PITCH)


def test_it_is_what_a_search_finds_on_hills_from_any_side() -> None:
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(44.0) * 2, np.arange(30.0) * 3)
    heights = sum(
        rng.uniform(4, 25) * np.exp(-((x - a) ** 2 + (y - b) ** 2) / rng.uniform(8, 20) ** 2)
        for a, b in rng.uniform(10, 80, (6, 2))
    )
    for azimuth, grazing in ((17.0, 25.0), (130.0, 50.0), (305.0, 65.0)):
        view = View(azimuth, grazing)
        classes = layover_shadow(heights, (2.0, 3.0), view)
        assert {FREE, SHADOW} <= set(np.unique(classes)) or grazing > 30
        assert np.mean(classes != searched(heights, (2.0, 3.0), view)) < 0.02  # edges fall between places


def searched(heights: np.ndarray, pitch: tuple[float, float], view: View) -> np.ndarray:
    """The definition, place by place: every one compared with all that are as far along the flight."""
    from scipy.interpolate import RegularGridInterpolator

    rows, columns = heights.shape
    x, y = np.arange(columns) * pitch[0], -np.arange(rows) * pitch[1]
    at = RegularGridInterpolator((y[::-1], x), heights[::-1], bounds_error=False)
    ahead = view.look.ahead
    steps = np.arange(-150, 150.01, 0.5)
    found = np.zeros(heights.shape, np.uint8)
    for i in range(rows):
        for j in range(columns):
            line = np.array([x[j], y[i]]) + steps[:, None] * ahead
            z = at(line[:, ::-1])
            elevation, slant = view.look.in_section(steps, z)
            own_elevation, own_slant = view.look.in_section(0.0, heights[i, j])
            with np.errstate(invalid="ignore"):
                shadow = (elevation[steps < 0] > own_elevation + 1e-9).any()
                nearer, farther = slant[steps < 0] > own_slant + 1e-9, slant[steps > 0] < own_slant - 1e-9
            found[i, j] = SHADOW * shadow + LAYOVER * (nearer.any() or farther.any())
    return found


def test_level_ground_has_neither_and_unknown_places_hide_nothing() -> None:
    assert not layover_shadow(np.full((30, 50), 7.0), (1.0, 1.0), View(33, 20)).any()
    heights = box()
    heights[150:250, 150:250] = np.nan
    classes = layover_shadow(heights, (PITCH, PITCH), View(EAST, 30))
    assert (classes[150:250, 150:250] == UNKNOWN).all()
    assert not np.isin(classes, (SHADOW, LAYOVER, BOTH)).any()


@pytest.mark.parametrize("azimuth", [EAST, 33.0, SOUTH])
def test_the_rims_of_holes_in_a_plateau_are_as_the_plateau(azimuth: float) -> None:
    heights = np.full((40, 40), 800.0)
    heights[10:20, 15:25] = np.nan
    classes = layover_shadow(heights, (1.0, 1.0), View(azimuth, 40))
    np.testing.assert_array_equal(classes, np.where(np.isnan(heights), UNKNOWN, FREE))
    assert (layover_shadow(np.full((4, 4), np.nan), (1.0, 1.0), View(azimuth, 40)) == UNKNOWN).all()


def test_left_looking_is_the_same_and_tilted_views_and_large_maps_are_refused() -> None:
    right, left = (layover_shadow(box(), (PITCH, PITCH), View(20, 40, side=side)) for side in ("right", "left"))
    np.testing.assert_array_equal(right, left)
    with pytest.raises(SarsplatError, match="level view"):
        layover_shadow(box(), (PITCH, PITCH), View(20, 40, tilt_deg=10))
    with pytest.raises(SarsplatError, match="too large for layover and shadow"):
        layover_shadow(np.zeros((30, 40)), (0.001, 1000.0), View(20, 40))


@pytest.mark.parametrize("azimuth", [45.0, 17.0, 300.0])
def test_a_long_and_narrow_map_takes_no_more_than_it_holds(azimuth: float) -> None:
    """Not its length squared."""
    line = 3 * np.sin(np.arange(3000) / 5) ** 2
    tracemalloc.start()
    classes = layover_shadow(line[None], (1.0, 1.0), View(azimuth, 40))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3000 * 3000  # bytes
    short = layover_shadow(line[None, :200], (1.0, 1.0), View(azimuth, 40))
    assert (classes[0, 5:195] == short[0, 5:195]).all()  # what hides a place is less than 5 m away


def test_what_does_not_fit_into_memory_is_refused_before_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sarsplat.radar.layover_shadow._AT_A_TIME", 1 << 18)
    for shape in ((225, 275), (75, 1000)):
        heights = np.zeros(shape)
        heights[::7] = np.nan
        needed: list[float] = []
        with monkeypatch.context() as patch:
            patch.setattr("sarsplat.radar.layover_shadow.required", lambda _, most, __, to=needed: to.append(most))
            tracemalloc.start()
            layover_shadow(heights, (1.0, 1.0), View(45, 40))
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < needed[0] < 1.5 * peak
    monkeypatch.setattr("sarsplat.memory.free_bytes", lambda: 2**30 / 64)
    with pytest.raises(SarsplatError, match=r"1000 places takes about 0\..* GiB of memory, and 0\.016 GiB .* cut it"):
        layover_shadow(heights, (1.0, 1.0), View(45, 40))
