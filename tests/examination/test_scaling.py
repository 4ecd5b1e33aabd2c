"""Cut-off, stretched and repeated pictures are found; pictures of one scale are not taken for these."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from made import dataset_of
from sarsplat.data import Dataset
from sarsplat.examination.outcome import Examination
from sarsplat.examination.plausible import repeated_images
from sarsplat.examination.scaling import examine_cut_off, examine_scaling, share_at_top
from sarsplat.geometry import ImageGrid, View

COUNT = 12
GRID = ImageGrid(40, 48, (0.2, 0.2), (0.3, 0.3))


def pictures(seed: int = 0, step_deg: float = 30.0, **fields) -> Dataset:
    """Amplitude of a few thousand, squared: a bright square on ground, with speckle."""
    mean = np.full((40, 48), 0.1)
    mean[16:24, 20:28] = 20.0
    power = np.random.default_rng(seed).exponential(size=(COUNT, 40, 48)) * mean
    views = [(View(step_deg * k, 30.0), "train") for k in range(COUNT)]
    fields = {"looks": 1.0, "ground": True, "calibration": "relative", "source": {"kind": "folder"}, **fields}
    return dataset_of(GRID, views, power.astype(np.float32), **fields)


def stored(dataset: Dataset, factor: float | np.ndarray, largest: int = 255) -> Dataset:
    """As pictures of whole numbers."""
    amplitude = np.clip(np.round(np.sqrt(dataset.power) * factor), 1, largest)
    return replace(dataset, power=np.square(amplitude, dtype=np.float32))


def scaled(dataset: Dataset) -> list[str]:
    examined = Examination()
    cut_off = examine_cut_off(dataset, examined)
    examine_scaling(dataset, examined, True, cut_off)
    return examined.contradictions


@pytest.mark.parametrize("seed", range(5))
def test_pictures_of_one_scale_pass(seed):
    dataset = pictures(seed)
    for one in (dataset, stored(dataset, 25), stored(dataset, 35), stored(dataset, 200, 4095)):
        assert scaled(one) == []


@pytest.mark.parametrize("largest", [255, 4095, 65535])
def test_pixels_at_the_largest_value_were_cut_off(largest):
    (said,) = scaled(stored(pictures(), largest / 1.0, largest))
    assert "hold its largest value, and at least 1% in 12 of 12 images" in said


def test_a_few_are_only_said():
    examined = Examination()
    assert 0 < examine_cut_off(stored(pictures(), 35), examined) < 0.01
    assert "were cut off" in examined.checks["largest values"]
    assert examined.contradictions == []


def test_a_largest_value_of_few_levels_is_not_cut_off():
    levels = np.random.default_rng(0).choice(4, size=(64, 64), p=(0.6, 0.25, 0.1, 0.05)).astype(np.float32)
    assert share_at_top(levels) == 0


def test_parts_of_complex_amplitudes_that_were_cut_off():
    rng = np.random.default_rng(0)
    signal = (rng.normal(size=(3, 40, 48, 2)) @ [1, 1j]).astype(np.complex64)
    signal = np.clip(signal.real, -1.5, 1.5) + 1j * np.clip(signal.imag, -1.5, 1.5)
    views = [(View(120.0 * k, 30.0), "train") for k in range(3)]
    examined = Examination()
    assert examine_cut_off(dataset_of(GRID, views, signal.astype(np.complex64), ground=True), examined) > 0.1
    assert len(examined.contradictions) == 1


@pytest.mark.parametrize("by", ["brightest", "share", "mean"])
def test_pictures_that_are_stretched_one_by_one(by):
    dataset = pictures()
    amplitude = np.sqrt(dataset.power * np.linspace(0.2, 3.0, COUNT)[:, None, None])
    own = {
        "brightest": amplitude.max(axis=(1, 2)) / 255,
        "share": np.quantile(amplitude, 0.996, axis=(1, 2)) / 255,
        "mean": np.sqrt(np.square(amplitude).mean(axis=(1, 2))),
    }[by][:, None, None]
    power = np.square(amplitude / own if by == "mean" else np.clip(np.round(amplitude / own), 1, 255))
    (said,) = scaled(replace(dataset, power=power.astype(np.float32)))
    assert said.startswith("the images seem to be stretched one by one")


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_one_picture_of_another_scale_is_named(factor):
    (said,) = scaled(with_copy(pictures(), factor * pictures().power[7]))
    assert re.match(f"the ground of 007 is (9.9|10.[01]) dB {'darker' if factor < 1 else 'brighter'}", said)


def with_copy(dataset: Dataset, copy: np.ndarray) -> Dataset:
    power = dataset.power.copy()
    power[7] = copy
    return replace(dataset, power=power)


def test_one_picture_under_two_directions_is_named():
    dataset = pictures()
    (said,) = repeated_images(with_copy(dataset, dataset.power[2]))
    assert said.startswith("002 (azimuth 60°, grazing 30°) and 007 (azimuth 210°, grazing 30°) are one")
    assert repeated_images(dataset) == []


def test_one_picture_twice_under_one_direction_counts_twice():
    dataset = with_copy(pictures(), pictures().power[2])
    entries = [*dataset.entries]
    entries[7] = replace(entries[7], view=entries[2].view)
    (said,) = repeated_images(replace(dataset, entries=tuple(entries)))
    assert said.startswith("002 and 007 are one and the same picture from one direction")


def test_targets_without_speckle_may_be_symmetric():
    half = pictures().power[:6]
    symmetric = replace(pictures(looks=None), power=np.concatenate([half, half]))
    assert repeated_images(symmetric) == []
    rounded = with_copy(symmetric, half[1] + 1e-3 * half[1].max())
    assert repeated_images(rounded) == []
    assert len(repeated_images(with_copy(symmetric, half[2]))) == 1
    assert repeated_images(symmetric.take([0, 6])) == []  # left and right


def large(seed: int) -> Dataset:
    """Four times as large, so that the speckle of a single image can be measured."""
    parts = [pictures(4 * seed + k).power for k in range(4)]
    power = np.concatenate([np.concatenate(parts[:2], axis=1), np.concatenate(parts[2:], axis=1)], axis=2)
    dataset = pictures(seed)
    return replace(dataset, power=power, grid=replace(dataset.grid, rows=80, columns=96))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("change", "said"),
    [(np.sqrt, "amplitude or smoothed"), (np.square, "squared, or all others amplitude")],
    ids=["root", "square"],
)
def test_one_image_in_another_unit_is_found_by_its_speckle(change, said, seed):
    dataset = large(seed)
    power = dataset.power.copy()
    power[5] = change(power[5]) * np.median(power) / np.median(change(power[5]))  # as bright as the others
    assert scaled(dataset) == []
    (text,) = scaled(replace(dataset, power=power))
    assert "ground of 005 is" in text
    assert f"as if it were {said}" in text


def test_clean_test_images_among_speckled_ones_pass():
    dataset = large(0)
    power = dataset.power.copy()
    power[8:] = power[:8].mean(axis=0) * np.random.default_rng(0).gamma(20, 1 / 20, power[8:].shape)
    entries = tuple(replace(entry, split="test" if k >= 8 else "train") for k, entry in enumerate(dataset.entries))
    clean = replace(dataset, power=power, entries=entries, clean_tests=True)
    assert scaled(clean) == []
    assert "as if it were amplitude or smoothed" in scaled(replace(clean, clean_tests=False))[0]
