"""What looks like a mistake is told by name; what somebody may well mean, and echoes can make, is not."""

import itertools
import math
import warnings
from dataclasses import replace

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


@pytest.mark.parametrize("name", RADIANS)
def test_radians_are_suspected(name: str) -> None:
    (told,) = suspicious_angles(RADIANS[name])
    assert "look like radians; if they are, multiply" in told


@pytest.mark.parametrize("name", HONEST)
def test_honest_angles_are_not(name: str) -> None:
    assert suspicious_angles(HONEST[name]) == []


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
    ],
)
def test_odd_views(train: list[View], told: str) -> None:
    assert told in suspicions(make(train))[0]


def test_from_above_no_side_is_left_out() -> None:
    above = views(range(0, 90, 10), [89.9])
    assert not any("gap" in told for told in suspicions(make(above)))
    told, *_ = suspicions(make([*above, *views([20, 40], [30])]))
    assert "leave a gap of 340° in azimuth, from 40° clockwise to 20°" in told


@pytest.mark.parametrize(("azimuths", "asked"), [(np.arange(0, 6.28, 0.26), True), (range(0, 60, 5), False)])
def test_what_may_be_degrees_or_radians_is_asked(azimuths, asked: bool) -> None:
    told, *_ = suspicions(make(views(azimuths, [30])))
    assert ("add views there (or are the azimuths radians?)" in told) is asked


def test_half_a_circle_is_enough() -> None:
    for azimuths in ((0, 180), (0, 90, 270), (-90, 0, 90), (0, 120, 240)):
        assert not any("gap" in told for told in suspicions(make(views(azimuths, [45]))))


def test_images_all_the_same() -> None:
    (told,) = suspicions(make(AROUND, np.repeat(noise(1), 3, axis=0)))
    assert told.startswith("all 3 training images are the same")


def test_constant_images_are_counted_and_the_first_is_named() -> None:
    images = noise(5)
    images[1], images[4] = 0.5, 0
    (told,) = suspicions(make(AROUND, images, test=[View(60, 30), View(70, 30)]))
    assert told.startswith("2 of 5 images are constant (image 001 is 0.5 everywhere)")


def test_nothing_is_odd_about_a_sound_dataset_or_a_single_pixel() -> None:
    assert suspicions(make(AROUND, test=[View(60, 30)])) == []
    assert suspicions(make(AROUND, noise(3)[:, :1, :1].copy(), grid=ImageGrid(1, 1, (1, 1), (1, 1)))) == []


def test_zeros_of_measured_power_are_counted() -> None:
    images = noise(3)
    images[0, 2, :5] = 0
    assert suspicions(make(AROUND, images)) == []  # rendered: nothing there to scatter
    (told,) = suspicions(make(AROUND, images, calibration="relative"))
    assert told.startswith("5 pixels of 192 in set train are zero")


def test_test_images_that_were_trained_on() -> None:
    images = noise(5)
    images[3] = images[1]  # of the same view: a copy; images[4] is another image of a view that was trained on
    (told,) = suspicions(make(AROUND, images, test=[AROUND[1], AROUND[2]]))
    assert "1 test image can be found among the training images (003 is 001)" in told


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


def test_what_is_proposed_helps() -> None:
    low = ring(8, 15)
    (told,) = weak_directions(low)
    assert "such as 60°" in told
    assert weakest_direction([*low, *ring(8, 60)]).conditioning < weakest_direction(low).conditioning / 2


@pytest.mark.parametrize("grazing", [10.0, 20.0, 40.0])
def test_many_views_around_have_a_closed_form(grazing: float) -> None:
    """A side in front of the views at azimuth φ, seen with cos φ: ⟨cos²φ⟩ = 2/3, ⟨cos φ⟩ = π/4."""
    sin, cos = math.sin(math.radians(grazing)), math.cos(math.radians(grazing))
    open_ = [[sin**2 * 2 / 3, sin * cos * math.pi / 4], [sin * cos * math.pi / 4, cos**2]]  # outwards and upwards
    values, vectors = np.linalg.eigh(open_)
    found = weakest_direction(ring(360, grazing))
    assert found.conditioning == pytest.approx(1 / math.sqrt(1 - values[-1]), rel=1e-3)
    assert found.above_horizon_deg == pytest.approx(math.degrees(math.asin(abs(vectors[1, -1]))), abs=0.2)


def test_the_conditioning_depends_on_neither_the_zero_of_azimuth_nor_the_order() -> None:
    turned = [View(view.azimuth_deg + 35, view.grazing_deg) for view in reversed(PAPER)]
    assert weakest_direction(turned).conditioning == pytest.approx(weakest_direction(PAPER).conditioning)


FLAT = [View.isar((math.cos(k), math.sin(k), 0.01), (0, 0, 1)) for k in range(6)]
INCLINED = [View.isar((math.cos(k), 1.0, math.sin(k)), (0, 1, 0.0)) for k in range(6)]


def test_aloft_angles_follow_from_vectors_and_no_azimuth_is_a_side() -> None:
    below = [View(0.9 * k, -30.1, aloft=True) for k in range(6)]  # of which all are below π/2
    assert suspicious_angles(below) == []
    assert suspicions(make([*FLAT, *INCLINED])) == []


def test_aloft_another_axis_is_advised_not_another_grazing_angle() -> None:
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
    views = [(View(360 * k / count, 30.0), "train") for k in range(count)]
    looks = {"looks": 1.0} if ground else {}
    return dataset_of(grid, views, power.astype(np.float32), ground=ground, calibration="relative", **looks)


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


@pytest.mark.parametrize("place", [(2, 10, 12), (5, 0, 0), (0, 39, 7)])
@pytest.mark.parametrize("level_db", [45.0, 90.0, 150.0])
def test_a_hot_pixel_is_named(place, level_db):
    (said,) = found(changed(images(1.2, 30.0), place, 10 ** (level_db / 10)))
    assert said.startswith(
        f"1 pixel of 1 image stands alone, such as row {place[1]}, column {place[2]} of 00{place[0]}"
    )


def test_hot_pixels_of_all_images_are_counted():
    (said,) = found(changed(images(), (slice(None), 10, 12), 1e12))
    assert said.startswith("6 pixels of 6 images stand alone")


def test_a_block_that_is_too_bright_for_any_radar_is_named():
    for ground in (True, False):
        (said,) = found(changed(images(1.2, 20.0, ground), (4, slice(8, 11), slice(8, 11)), 1e15))
        assert said.startswith("the brightest pixel of 004, row 8, column 8, is 1")


@pytest.mark.parametrize(("place", "name"), [((1, 7), "row 7"), ((1, slice(None), 7), "column 7")])
def test_hot_lines_are_named(place, name):
    (said,) = found(changed(images(), place, 1e3))
    assert said.startswith(f"{name} of 001 is as a whole")


def test_a_wall_along_a_row_is_true():
    dataset = images(1.2)
    power = dataset.power.copy()
    power[:, 18:23, 4:32] += (1e4 * np.exp2(-4 * (np.arange(-2, 3) / 1.2) ** 2))[:, None].astype(np.float32)
    assert found(replace(dataset, power=power)) == []


def test_coarsely_quantised_ground_has_no_hot_lines():
    dataset = images()
    assert found(replace(dataset, power=np.where(dataset.power > 1.5, np.float32(1), np.float32(1e-3)))) == []


def unweighted(offset: tuple[float, float], reflector_db: float) -> Dataset:
    """Speckle and a point of exactly critical sampling without weighting, so many pixels off the middle of one."""
    size, count = 48, 6
    frequency = np.fft.fftfreq(size)
    rng = np.random.default_rng(4)
    amplitude = rng.standard_normal((count, size, size)) + 1j * rng.standard_normal((count, size, size))
    point = np.fft.ifft2(np.outer(*(np.exp(-2j * np.pi * frequency * at) for at in np.add((20, 30), offset))))
    power = np.abs(amplitude / np.sqrt(2) + 10 ** (reflector_db / 20) * point) ** 2
    grid = ImageGrid(size, size, (0.2, 0.2), (0.2 * 0.886, 0.2 * 0.886))
    views = [(View(360 * k / count, 30.0), "train") for k in range(count)]
    return dataset_of(grid, views, power.astype(np.float32), ground=True, calibration="relative", looks=1.0)


@pytest.mark.parametrize("reflector_db", [40.0, 60.0])
def test_a_critically_sampled_reflector_is_true_wherever_it_is_in_its_pixel(reflector_db):
    for offset in ((0, 0), (0, 0.5), (0.003, 0), (0.03, 0.01), (0.1, -0.1), (0.5, 0.5)):
        assert found(unweighted(offset, reflector_db)) == []


@pytest.mark.parametrize("level_db", [70.0, 180.0])
def test_a_hot_pixel_is_named_among_critically_sampled_ones(level_db):
    (said,) = found(changed(unweighted((0.2, 0.3), 10.0), (3, 11, 12), 10 ** (level_db / 10)))
    assert said.startswith("1 pixel of 1 image stands alone, such as row 11, column 12 of 003")
