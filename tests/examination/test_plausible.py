"""What looks like a mistake is told by name; what somebody may well mean, and echoes can make, is not."""

import itertools
import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from made import dataset_of
from sarsplat import Dataset, ImageGrid, SarsplatWarning, View, mstar_views, paper_views
from sarsplat.examination.outcome import Examination
from sarsplat.examination.plausible import suspicions, suspicious_angles, warn, weak_directions, weakest_direction
from sarsplat.examination.single_values import examine_single_values

GRID = ImageGrid(8, 8, (0.3, 0.3), (0.3, 0.3))
AROUND = [View(azimuth, 45) for azimuth in (0, 120, 240)]


def views(azimuths, grazings) -> list[View]:
    return [View(float(azimuth), float(grazing)) for azimuth in azimuths for grazing in grazings]


RADIANS = {
    "a circle": views(np.arange(0, 2 * math.pi, math.pi / 12), [0.2618, 0.7854, 1.309]),
    "half a circle either way": views(np.linspace(-math.pi, math.pi, 9), [0.3]),
    "typed with two decimals": views(np.arange(0, 6.28, 0.26), [0.26]),
    "as incidence": views(np.arange(0, 6.28, 0.26), [90 - 0.26, 90 - 1.31]),
    "grazing in degrees": views(np.arange(0, 2 * math.pi, math.pi / 12), [15, 45]),
    "four decimals": views(np.round(np.radians([0, 10, 47, 98, 203, 359]), 4), [17]),
    "steps of 7.5": views(np.radians(np.arange(0, 360, 7.5)), [30]),
    "against the sense of azimuths": views(-np.radians(np.arange(0, 360, 7.5)), [17]),
    "on both sides of the nose": views(np.radians(np.arange(-180, 180, 7.5)), [17]),
    "steps of 15, two decimals": views(np.round(np.radians(np.arange(0, 360, 15)), 2), [30]),
    "uneven": views(np.radians(np.random.default_rng(0).uniform(0, 360, 36)), [17]),
    "azimuths in degrees": views(range(0, 360, 15), [0.5236]),
    "azimuths in degrees, three grazings": views(range(0, 360, 15), np.radians([15, 30, 45])),
    "two views": views([0, 1.5708], [0.52]),
    "three azimuths": views([0, 2.0944, 4.1888], [30]),
}

HONEST = {
    "0 to 3 by 1": views(range(4), [17]),
    "0 to 3 by 1, grazing 1": views(range(4), [1]),
    "one view": [View(0.5, 0.5)],
    "a short arc": views(np.arange(-5, 5.1, 0.25), [30]),
    "a fine arc": views(np.arange(0, 6, 0.01), [45]),
    "a very short arc, very low": views(np.arange(0, 1.5, 0.1), [1.5]),
    "two views": views([0.3, 6], [0.5]),
    "steps of a half, low": views(np.arange(0, 6, 0.5), [1.5]),
    "steps of 1.25, low": views(np.arange(0, 5.1, 1.25), [1.25]),
    "0 to 6 by 1, very low": views(range(7), [0.5]),
    "some of them low": views([0, 90, 200], [0.52, 45]),
    "from above": views([0, 0.5, 1, 1.7, 2.2], [88.6]),
    "paper": [view for view, _ in paper_views()],
    "mstar": [view for view, _ in mstar_views()],
}


@pytest.mark.parametrize(
    "angles", [*RADIANS.values(), *HONEST.values()], ids=[*RADIANS, *map("honest: {}".format, HONEST)]
)
def test_radians_are_suspected_and_honest_angles_are_not(angles: list[View]) -> None:
    told = suspicious_angles(angles)
    assert ["look like radians; if they are, multiply" in text for text in told] == [True] * (
        angles in RADIANS.values()
    )


def test_no_raster_of_hundredths_is_suspected() -> None:
    chance = np.random.default_rng(0)
    ends = itertools.product((-600, 0, 600), (1, 400), (2, 40), (158, 8842))
    drawn = zip(*(chance.integers(low, high, 100) for low, high in ((-600, 601), (1, 401), (2, 41), (158, 8843))))
    for first, step, count, grazing in (*ends, *drawn):
        grid = [View((first + step * k) / 100, grazing / 100) for k in range(count)]
        assert suspicious_angles(grid) == [], (first, step, count, grazing)


def make(train: list[View], images: np.ndarray | None = None, test: list[View] | None = None, **options) -> Dataset:
    """A dataset of noise, or of these images."""
    items = [(view, "train") for view in train] + [(view, "test") for view in test or []]
    return dataset_of(options.pop("grid", GRID), items, noise(len(items)) if images is None else images, **options)


def noise(count: int) -> np.ndarray:
    return np.random.default_rng(1).exponential(size=(count, 8, 8)).astype(np.float32)


@pytest.mark.parametrize(
    ("train", "told"),
    [
        ([View(30, 40)], "one training view (azimuth 30°)"),
        ([View(30, 40)] * 4, "all 4 training views are the same (azimuth 30°, grazing 40°)"),
        ([View(30, 40), View(390, 40)], "all 2 training views are the same"),
        ([View(350, 40), View(10, 40), View(90, 40)], "leave a gap of 260° in azimuth, from 90° clockwise to 350°"),
        ([View(a / 100, 0.3) for a in range(0, 628, 26)], "look like radians"),
        (views(np.arange(0, 6.28, 0.26), [30]), "add views there (or are the azimuths radians?)"),
        (views(range(0, 60, 5), [30]), "clockwise to 0°, where the shape is a guess; add views there"),
        (
            views(range(0, 90, 10), [89.9]) + views([20, 40], [30]),
            "a gap of 340° in azimuth, from 40° clockwise to 20°",
        ),
    ],
)
def test_odd_views(train: list[View], told: str) -> None:
    text, *_ = suspicions(make(train))
    assert told in text and ("or are the azimuths radians" in text) == ("or are the azimuths radians" in told)


@pytest.mark.parametrize("azimuths", [(0, 180), (0, 90, 270), (-90, 0, 90), (0, 120, 240), "from above"])
def test_half_a_circle_is_enough_and_from_above_no_side_is_left_out(azimuths) -> None:
    sound = views(range(0, 90, 10), [89.9]) if azimuths == "from above" else views(azimuths, [45])
    assert not any("gap" in told for told in suspicions(make(sound)))


def with_images(*changes: tuple[Any, Any], **options) -> list[str]:
    """What is told of noise from three sides, and from others to test on, after changes of its images."""
    images = noise(3 + len(options.get("test", ())))
    for place, value in changes:
        images[place] = images[value] if isinstance(value, list) else value
    return suspicions(make(AROUND, images, **options))


TO_TEST, ZERO = [View(60, 30), View(70, 30)], ((0, 2, slice(5)), 0)


@pytest.mark.parametrize(
    ("changes", "options", "told"),
    [
        ([(..., [0])], {}, "all 3 training images are the same"),
        ([(1, 0.5), (4, 0)], {"test": TO_TEST}, "2 of 5 images are constant (image 001 is 0.5 everywhere)"),
        ([ZERO], {"calibration": "relative"}, "5 pixels of 192 in set train are zero"),
        # a copy; the last is another image of a view that was trained on
        ([(3, [1])], {"test": AROUND[1:]}, "1 test image can be found among the training images (003 is 001)"),
    ],
)
def test_odd_images(changes, options, told: str) -> None:
    (text,) = with_images(*changes, **options)
    assert text.startswith(told)


def test_nothing_is_odd_about_a_sound_dataset_a_single_pixel_or_zeros_that_were_rendered() -> None:
    assert with_images(test=TO_TEST) == with_images(ZERO) == []
    assert suspicions(make(AROUND, noise(3)[:, :1, :1].copy(), grid=ImageGrid(1, 1, (1, 1), (1, 1)))) == []


def test_warnings_have_one_category_and_are_not_repeated() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        warn(["odd", "odder"])
        warn(["odd"])
    assert [(str(item.message), item.category) for item in caught] == [(t, SarsplatWarning) for t in ("odd", "odder")]


def ring(count: int, *grazings: float) -> list[View]:
    return [View(360 * k / count, grazing) for k in range(count) for grazing in grazings]


def arc(width: float, *grazings: float) -> list[View]:
    return [View(azimuth, grazing) for azimuth in np.linspace(-width / 2, width / 2, 7) for grazing in grazings]


PAPER = [view for view, split in paper_views() if split == "train"]

SOUND = {"paper": PAPER, "8 at 45°": ring(8, 45), "4 at 3 grazing angles": ring(4, 15, 45, 75), "8 at 75°": ring(8, 75)}
UNCERTAIN = {
    "8 at 30°": ring(8, 30),
    "8 at 15°": ring(8, 15),
    "many at 15°": ring(36, 15),
    "mstar": [view for view, split in mstar_views() if split == "train"],
    "a quarter circle": arc(90, 45),
}
OPEN = {"left and right": ring(2, 45), "ten degrees": arc(10, 45), "a single view": [View(10, 30)]}


@pytest.mark.parametrize("name", [*SOUND, *UNCERTAIN, *OPEN])
def test_weak_directions_are_told(name: str) -> None:
    chosen = (SOUND | UNCERTAIN | OPEN)[name]
    assert weakest_direction(chosen).undetermined is (name in OPEN)
    expected = "do not determine positions along" if name in OPEN else "times less well along directions"
    assert [expected in told for told in weak_directions(chosen)] == [True] * (name not in SOUND)


def test_what_is_proposed_helps_and_neither_the_zero_of_azimuth_nor_the_order_matters() -> None:
    low = ring(8, 15)
    (told,) = weak_directions(low)
    assert "such as 60°" in told
    assert weakest_direction([*low, *ring(8, 60)]).conditioning < weakest_direction(low).conditioning / 2
    turned = [View(view.azimuth_deg + 35, view.grazing_deg) for view in reversed(PAPER)]
    assert weakest_direction(turned).conditioning == pytest.approx(weakest_direction(PAPER).conditioning)


@pytest.mark.parametrize("grazing", [10.0, 20.0, 40.0])
def test_many_views_around_have_a_closed_form(grazing: float) -> None:
    """A side in front of the views at azimuth φ, seen with cos φ: ⟨cos²φ⟩ = 2/3, ⟨cos φ⟩ = π/4."""
    sin, cos = math.sin(math.radians(grazing)), math.cos(math.radians(grazing))
    open_ = [[sin**2 * 2 / 3, sin * cos * math.pi / 4], [sin * cos * math.pi / 4, cos**2]]  # outwards and upwards
    values, vectors = np.linalg.eigh(open_)
    found = weakest_direction(ring(360, grazing))
    assert found.conditioning == pytest.approx(1 / math.sqrt(1 - values[-1]), rel=1e-3)
    assert found.above_horizon_deg == pytest.approx(math.degrees(math.asin(abs(vectors[1, -1]))), abs=0.2)


def test_aloft_no_azimuth_is_a_side_and_another_axis_is_advised_not_another_grazing_angle() -> None:
    below = [View(0.9 * k, -30.1, aloft=True) for k in range(6)]  # of which all are below π/2
    assert suspicious_angles(below) == []
    flat = [View.isar((math.cos(k), math.sin(k), 0.01), (0, 0, 1)) for k in range(6)]
    inclined = [View.isar((math.cos(k), 1.0, math.sin(k)), (0, 1, 0.0)) for k in range(6)]
    assert suspicions(make([*flat, *inclined])) == []
    (told,) = suspicions(make([View.isar((1, 0.1 * k, 0), (0, 0, 1)) for k in range(6)]))
    assert "add frames of a rotation about another axis" in told and "grazing" not in told


@pytest.mark.parametrize(("db", "told"), [(0, 0), (40, 0), (60, 1), (80, 1)])
def test_an_echo_that_outshines_all_else_is_said(db: int, told: int) -> None:
    """At 40 dB the target is still told from it; the echo is as wide as a point."""
    grid = ImageGrid(64, 64, (0.3, 0.3), (0.6, 0.6))
    rows, columns = np.mgrid[:64, :64]
    point = np.exp(-4 * math.log(2) * ((rows - 8) ** 2 + (columns - 8) ** 2) / 4)
    target = np.zeros((64, 64))
    target[20:50, 20:50] = np.exp(np.random.default_rng(0).normal(0, 1.5, (30, 30)))
    power = np.stack([target + 10 ** (db / 10) * target.max() * point] * len(AROUND)).astype(np.float32)
    odd = suspicions(dataset_of(grid, [(view, "train") for view in AROUND], power, ground=False))
    assert sum("more than 60 dB above nearly all that images show" in text for text in odd) == told


# ---- pixels and lines that no echo can make --------------------------------------------------------------------------
def images(width: float = 1.0, reflector_db: float | None = None, ground: bool = True, count: int = 6) -> Dataset:
    """Speckle of one look, or nothing, with a point of this brightness that is spread by the response."""
    grid = ImageGrid(40, 36, (0.2, 0.2), (0.2 * width, 0.2 * width))
    power = np.random.default_rng(3).exponential(size=(count, 40, 36)) if ground else np.zeros((count, 40, 36))
    if reflector_db is not None:
        rows, columns = np.indices((40, 36))
        away2 = (rows - 20) ** 2 + (columns - 18) ** 2  # at the middle of a pixel: all the power that can be is there
        power += 10 ** (reflector_db / 10) * np.exp2(-4 * away2 / width**2)
    return measured(grid, power, ground=ground, looks=1.0 if ground else None)


def measured(grid: ImageGrid, power: np.ndarray, **fields) -> Dataset:
    """From all around."""
    items = [(view, "train") for view in ring(len(power), 30.0)]
    return dataset_of(grid, items, power.astype(np.float32), calibration="relative", **fields)


def found(dataset: Dataset) -> list[str]:
    examined = Examination()
    assert examine_single_values(dataset, examined) == bool(examined.contradictions)
    return examined.contradictions


def changed(dataset: Dataset, place: tuple, value: float) -> Dataset:
    power = dataset.power.copy()
    power[place] = value
    return replace(dataset, power=power)


@pytest.mark.parametrize("width", [1.0, 1.2, 1.5, 2.5])
@pytest.mark.parametrize("ground", [True, False])
def test_a_corner_reflector_is_true_however_bright(width, ground):
    for level_db in (20.0, 40.0, 60.0, 90.0):
        assert found(images(width, level_db, ground)) == []


def test_a_wall_along_a_row_and_coarsely_quantised_ground_are_true():
    dataset = images(1.2)
    power = dataset.power.copy()
    power[:, 18:23, 4:32] += (1e4 * np.exp2(-4 * (np.arange(-2, 3) / 1.2) ** 2))[:, None].astype(np.float32)
    assert found(replace(dataset, power=power)) == []
    assert found(replace(dataset, power=np.where(dataset.power > 1.5, np.float32(1), np.float32(1e-3)))) == []


def unweighted(offset: tuple[float, float], reflector_db: float) -> Dataset:
    """Speckle and a point of exactly critical sampling without weighting, so many pixels off the middle of one."""
    size, count = 48, 6
    frequency = np.fft.fftfreq(size)
    rng = np.random.default_rng(4)
    amplitude = rng.standard_normal((count, size, size)) + 1j * rng.standard_normal((count, size, size))
    point = np.fft.ifft2(np.outer(*(np.exp(-2j * np.pi * frequency * at) for at in np.add((20, 30), offset))))
    power = np.abs(amplitude / np.sqrt(2) + 10 ** (reflector_db / 20) * point) ** 2
    return measured(ImageGrid(size, size, (0.2, 0.2), (0.2 * 0.886, 0.2 * 0.886)), power, ground=True, looks=1.0)


@pytest.mark.parametrize("reflector_db", [40.0, 60.0])
def test_a_critically_sampled_reflector_is_true_wherever_it_is_in_its_pixel(reflector_db):
    for offset in ((0, 0), (0, 0.5), (0.003, 0), (0.03, 0.01), (0.1, -0.1), (0.5, 0.5)):
        assert found(unweighted(offset, reflector_db)) == []


ALONE = "1 pixel of 1 image stands alone, such as row {1}, column {2} of 00{0}"
PLACES = [(2, 10, 12), (5, 0, 0), (0, 39, 7)]
CRITICAL, BLOCK = unweighted((0.2, 0.3), 10.0), (4, slice(8, 11), slice(8, 11))


@pytest.mark.parametrize(
    ("dataset", "place", "level_db", "words"),
    [
        *((images(1.2, 30.0), place, db, ALONE.format(*place)) for place in PLACES for db in (45, 90, 150)),
        *((CRITICAL, (3, 11, 12), db, ALONE.format(3, 11, 12)) for db in (70, 180)),
        (images(), (slice(None), 10, 12), 120, "6 pixels of 6 images stand alone"),
        *(
            (images(1.2, 20.0, ground), BLOCK, 150, "the brightest pixel of 004, row 8, col")
            for ground in (True, False)
        ),
        (images(), (1, 7), 30, "row 7 of 001 is as a whole"),
        (images(), (1, slice(None), 7), 30, "column 7 of 001 is as a whole"),
    ],
)
def test_hot_pixels_blocks_and_lines_are_named(dataset, place, level_db, words):
    (said,) = found(changed(dataset, place, 10 ** (level_db / 10)))
    assert said.startswith(words)
