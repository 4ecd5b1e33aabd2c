"""Images of any format on one grid, in sets, on one scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sarsplat.errors import SarsplatWarning
from sarsplat.geometry import View
from sarsplat.importers import MeasuredImage, dataset_of, summary
from sarsplat.importers.band_limited import resample

RESOLUTION = (0.3, 0.35)


def wave(rows: int, columns: int, spacing: tuple[float, float], center=(0.0, 0.0)) -> np.ndarray:
    """A few reflectors near the middle of the scene, with hardly anything beyond the band of 0.2 m pixels."""
    azimuth = (np.arange(columns) - (columns - 1) / 2) * spacing[0] + center[0]
    slant = (np.arange(rows) - (rows - 1) / 2) * spacing[1] + center[1]
    image = np.full((rows, columns), 1e-7 + 0j)
    for x, r, level in ((0.13, -0.4, 1.0), (-1.1, 0.9, 2j), (1.7, 1.3, -0.5 + 1j)):
        image += level * np.exp(-(((slant - r) / 0.5) ** 2))[:, None] * np.exp(-(((azimuth - x) / 0.45) ** 2))
    return image.astype(np.complex64)


def measured(index: int, count: int = 4, shape=(40, 44), spacing=(0.15, 0.17), center=(0.0, 0.0), **fields):
    pixels = fields.pop("pixels", None)
    if pixels is None:
        pixels = wave(*shape, spacing=spacing, center=center) * (1 + index)
    view = View(index * 360 / count, 20.0)
    return MeasuredImage(f"{index}.img", pixels, view, spacing, RESOLUTION, center, **fields)


def imported(images, **options):
    return dataset_of(images, target="thing", source={"kind": "made up", "assumptions": ["flat ground"]}, **options)


def test_images_that_fit_stay_as_they_are_but_for_the_scale():
    images = [measured(index) for index in range(4)]
    made = imported(images)
    assert (made.grid, made.splits(), made.ground, made.looks) == (images[0].grid, ("train",), True, 1.0)
    assert made.power.mean() == pytest.approx(1, rel=1e-5)
    scale = made.signal[0, 20, 20] / images[0].pixels[20, 20]
    np.testing.assert_allclose(made.signal, scale * np.stack([image.pixels for image in images]), rtol=1e-5)
    assert made.source["assumptions"] == ["flat ground"]
    assert made.source["mean_power"] == pytest.approx(abs(scale) ** -2, rel=1e-5)
    assert summary(made) == "4 views of 6.6 m × 6.8 m, largest gap 90°"
    absolute = imported(images, calibration="absolute")
    np.testing.assert_array_equal(absolute.signal[2], images[2].pixels)


def test_other_spacings_are_resampled_to_the_finest_without_loss():
    images = [measured(0), measured(1, shape=(34, 30), spacing=(0.2, 0.22)), measured(2, center=(0.31, -0.2))]
    with pytest.warns(SarsplatWarning) as told:
        made = imported(images, calibration="absolute")
    assert ["resampled to the finest" in str(one.message) for one in told] == [True, False]
    assert "cut to what they have in common" in str(told[1].message)
    assert made.grid.spacing_m == (0.15, 0.17)
    assert len(made.source["assumptions"]) == 3
    expected = wave(made.grid.rows, made.grid.columns, made.grid.spacing_m, made.grid.center_m)
    for index in range(3):
        error = np.abs(made.signal[index] / (1 + index) - expected).max()
        assert error < 1e-4 * np.abs(expected).max()  # −80 dB: what is left is beyond the edge of the smaller images


def test_power_stays_positive_and_in_place():
    images = [measured(index, pixels=np.abs(wave(40, 44, (0.15, 0.17))) ** 2) for index in range(2)]
    images.append(measured(2, spacing=(0.2, 0.2), pixels=np.abs(wave(40, 44, (0.2, 0.2))) ** 2))
    with pytest.warns(SarsplatWarning):
        made = imported(images, calibration="absolute")
    assert (made.signal, made.power.dtype) == (None, np.float32)
    np.testing.assert_allclose(made.power[2], made.power[0], atol=1e-2 * made.power.max())


def test_sets():
    images = [measured(index, count=8) for index in range(8)]
    made = imported(images, train_views=3)
    assert [entry.view.azimuth_deg for entry in made.entries if entry.split == "train"] == [0, 135, 225]
    assert summary(made) == "8 views (3 train, 5 test) of 6.6 m × 6.8 m, largest gap of the training views 135°"
    named = [measured(index, count=8, split="test-17" if index > 5 else "train") for index in range(8)]
    assert imported(named[::-1]).splits() == ("train", "test-17")


def test_training_views_are_of_every_grazing_angle():
    images = [
        replace(measured(index, count=12), name=f"{grazing} {index}", view=View(30 * index, grazing))
        for grazing in (15.0, 45.0, 75.0)
        for index in range(12)
    ]
    views = [entry.view for entry in imported(images, train_views=6).entries if entry.split == "train"]
    assert sorted((view.azimuth_deg, view.grazing_deg) for view in views) == [
        *((0, 15), (60, 45), (120, 75), (180, 15), (240, 45), (300, 75))
    ]


def test_zeros_are_raised_and_that_is_said():
    images = [measured(index) for index in range(2)]
    images[1].pixels[3:5, 4] = 0
    with pytest.warns(SarsplatWarning, match=r"2 pixels of 3,520 held zero.*raised to -30 dB"):
        made = imported(images)
    assert made.power.min() > 0


@pytest.mark.parametrize("oversampling", [1.2, 1.5, 3.0])
def test_a_band_limited_signal_is_found_between_its_samples(oversampling):
    rng = np.random.default_rng(0)
    frequencies = rng.uniform(-0.5, 0.5, (2, 20)) / oversampling  # cycles per pixel
    levels = rng.normal(size=20) + 1j * rng.normal(size=20)

    def signal(rows, columns):
        along = np.exp(2j * np.pi * np.outer(rows, frequencies[0]))
        return (along * levels) @ np.exp(2j * np.pi * np.outer(columns, frequencies[1])).T

    pixels = signal(np.arange(70), np.arange(64)).astype(np.complex64)
    rows, columns = np.linspace(25, 44, 37), np.linspace(24.3, 38.9, 33)  # half the taps from the edge
    found = resample(pixels, rows, columns)
    error_db = 20 * np.log10(np.abs(found - signal(rows, columns)).max() / np.abs(pixels).max())
    assert error_db < -85
    assert found.dtype == np.complex64


def test_beyond_the_edge_there_is_nothing():
    assert not resample(np.ones((5, 5), np.float32), np.array([60.0]), np.array([2.0])).any()
