"""Responses of the system: width, energy, side lobes, files, and what is refused."""

import json
import math

import numpy as np
import pytest

from sarsplat import ImageGrid, SarsplatError
from sarsplat.geometry.responses import GAUSSIAN, RESPONSES, TAYLOR, UNIFORM, Sampled, Taylor, response_of, variance_of

TRIANGLE = Sampled((0, 1, 2, 3, 4), (8, 6, 3, 0, 0))  # half its peak at 1 + 2/3
SHAPES = [GAUSSIAN, TAYLOR, UNIFORM, Taylor(50, 8), TRIANGLE]
FINE = np.arange(-300_000, 300_001) * 1e-3


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_its_width_is_1_and_its_energy_is_kept(shape):
    peak, half, inside, outside = shape.density(np.array([0.0, 0.5, 0.45, -0.55]))
    assert half == pytest.approx(peak / 2, rel=1e-12)
    assert outside < half < inside < peak
    assert shape.density(FINE).sum() * 1e-3 == pytest.approx(1, abs=1e-5)
    in_metres = shape.density(np.array([0.15, -0.06]), variance_of(0.3))  # of a 3 dB width of 0.3 m
    assert in_metres == pytest.approx(shape.density(np.array([0.5, 0.2])) / 0.3, rel=1e-12)


def test_the_gaussian_is_in_closed_form():
    assert variance_of(1.0) == 1 / (8 * math.log(2))
    exact = 2 * math.sqrt(math.log(2) / math.pi) * 16.0 ** (-(FINE**2))
    np.testing.assert_allclose(GAUSSIAN.density(FINE), exact, rtol=1e-9, atol=1e-12)
    assert GAUSSIAN.main_lobe == math.inf
    assert not GAUSSIAN.side_lobes(FINE[300_000:]).any()


@pytest.mark.parametrize(
    ("level", "near", "expected"),
    [
        (35.0, 4, (0.2954333282763, 0.6388967447584, 1.156968059588, 1.55562154476)),
        (35, 1, (1, 1, 1, 1)),
        (20.5, 3, (0.6769184402831, 0.8163886577613, 1.063774512686, 1.274667868128)),
        (60.0, 12, (0.05408859281947, 0.3888766066499, 1.122785690555, 1.900120470418)),
    ],
)
def test_the_window_is_scipys(level, near, expected):
    """Every other one of `scipy.signal.windows.taylor(16, near, level, norm=False)[:8]`."""
    places = (np.arange(0, 8, 2) + 0.5) / 16 - 0.5
    window = Taylor(level, near).window(np.concatenate([places, -places]))
    assert window == pytest.approx(np.tile(expected, 2), rel=1e-12)


@pytest.mark.parametrize(("shape", "level_db", "width"), [(TAYLOR, -35, 1.1842), (UNIFORM, -13.26, 0.8859)])
def test_the_level_of_side_lobes_is_theirs(shape, level_db, width):
    beyond = np.linspace(shape.main_lobe, 20, 5001)
    assert 10 * np.log10(shape.side_lobes(beyond).max()) == pytest.approx(level_db, abs=0.3)
    assert not shape.side_lobes(np.linspace(0, shape.main_lobe - 0.06, 100)).any()
    whole = shape.density(beyond) / shape.density(np.zeros(1))
    assert shape.side_lobes(beyond) == pytest.approx(whole, rel=1e-9)
    assert shape.width == pytest.approx(width, abs=1e-4)


def test_the_difference_from_a_gaussian_is_that_of_the_conventions():
    away = np.abs(TAYLOR.density(FINE) - GAUSSIAN.density(FINE))
    assert away.sum() * 1e-3 == pytest.approx(0.042, abs=1e-3)
    assert away[300_000] / GAUSSIAN.density(np.zeros(1)) == pytest.approx(0.02, abs=2e-3)


def test_a_table_may_have_any_unit_and_side_lobes():
    places = np.linspace(0, 12, 4001)
    power = TAYLOR.density(places)
    table = Sampled(7 * places, 1e6 * power)
    assert table.main_lobe == pytest.approx(TAYLOR.main_lobe, abs=0.05)
    assert table.density(places[:-1]) == pytest.approx(power[:-1], rel=1e-3, abs=1e-6)
    assert table.reach == pytest.approx(12, rel=1e-3)


def test_beyond_its_reach_a_response_stays_below_a_power():
    for shape, power in ((TAYLOR, 1e-4), (UNIFORM, 1e-3), (GAUSSIAN, 1e-4)):
        reach = shape.reach_above(power)
        peak = shape.density(np.zeros(1))
        assert shape.density(np.linspace(reach + 0.1, 100, 20_001)).max() < power * peak
        assert shape.density(np.linspace(reach - 1, reach, 1001)).max() > power * peak


def test_the_amplitude_is_the_transform_of_the_window():
    distance = np.linspace(-8, 8, 401)
    places = (np.arange(512) + 0.5) / 512 - 0.5
    for shape in (TAYLOR, UNIFORM):
        window = shape.window(places)
        waves = np.cos(2 * np.pi * np.outer(distance * shape.width, places))
        assert shape.amplitude(distance) == pytest.approx(waves @ window / window.sum(), abs=0.01)
    assert GAUSSIAN.amplitude(distance) == pytest.approx(2.0 ** -(2 * distance**2), abs=1e-4)


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_files_give_it_back(shape):
    again = response_of(json.loads(json.dumps(shape.as_dict())))
    assert again == shape and hash(again) == hash(shape)
    grid = ImageGrid(4, 6, (0.2, 0.3), (0.3, 0.4), (1.0, 2.0), shape)
    assert ImageGrid.of(**json.loads(json.dumps(grid.as_dict()))) == grid
    assert ("response" in grid.as_dict()) == (shape != GAUSSIAN)


def test_a_grid_asks_it():
    grid = ImageGrid(4, 6, (0.2, 0.3), (0.3, 0.4), response=TAYLOR)
    assert grid.response_variance_m2 == (variance_of(0.3), variance_of(0.4))
    wider = grid.widened(0.01, 0.0)
    assert wider.response_variance_m2 == pytest.approx((variance_of(0.3) + 0.01, variance_of(0.4)), rel=1e-12)
    assert wider.response is TAYLOR
    with pytest.raises(SarsplatError, match=r"response is 'taylor'; give Gaussian"):
        ImageGrid(4, 6, (0.2, 0.3), (0.3, 0.4), response="taylor")


TABLES = [
    *(([0, 1], powers) for powers in ([1], None, [1, math.nan], [1, 0.5], [1, -1])),
    *((distances, [3, 2, 1]) for distances in ([0, 2, 1], [1, 2, 3])),
    ([0, 1, 2], [1, 2, 0]),
    (np.zeros((3, 900)), np.ones((3, 900))),
]
BAD = [
    ("taylor", "the response None is unknown; choose one of gaussian"),
    ({"kind": "hann"}, f"the response 'hann' is unknown; choose one of {', '.join(RESPONSES)}"),
    ({"kind": "gaussian", "level_db": 3}, r"cannot have the settings \{'level_db': 3\}: .*level_db"),
    *(({"kind": "taylor", "level_db": level}, f"level_db {level!r}") for level in ("35", 3.0, math.nan)),
    *(({"kind": "taylor", "sidelobes": count}, f"sidelobes {count}") for count in (4.5, 0)),
    *(({"kind": "sampled", "distances": a, "powers": b}, "sampled resp") for a, b in TABLES),
]


@pytest.mark.parametrize(("settings", "words"), BAD)
def test_invalid_responses_are_refused_in_one_sentence(settings, words):
    with pytest.raises(SarsplatError, match=words) as caught:
        response_of(settings)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
