"""Pixels and lines that no echo can make are found, and bright echoes are not taken for these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made import dataset_of
from sarsplat.data import Dataset
from sarsplat.examination.outcome import Examination
from sarsplat.examination.single_values import examine_single_values
from sarsplat.geometry import ImageGrid, View


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


@pytest.mark.parametrize("level_db", [60.0, 120.0, 170.0])
def test_a_hot_pixel_is_named_among_critically_sampled_ones(level_db):
    (said,) = found(changed(unweighted((0.2, 0.3), 10.0), (3, 11, 12), 10 ** ((level_db + 10) / 10)))
    assert said.startswith("1 pixel of 1 image stands alone, such as row 11, column 12 of 003")
