"""Images of any format on one grid, in sets, on one scale: empty corners are no data, and one file does not decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import rotate

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import View
from sarsplat.importers import MeasuredImage, dataset_of, summary
from sarsplat.importers.band_limited import resample

RESOLUTION = (0.3, 0.35)
RNG = np.random.default_rng(0)


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


def image(index: int, power: np.ndarray, spacing: float = 0.2) -> MeasuredImage:
    return measured(index, 12, pixels=power.astype(np.float32), spacing=(spacing, spacing))


def speckle(rows: int = 64, columns: int = 64) -> np.ndarray:
    power = RNG.exponential(size=(rows, columns))
    power[rows // 2 - 3 : rows // 2 + 3, columns // 2 - 3 : columns // 2 + 3] *= 100
    return power


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


@pytest.mark.parametrize("turn_deg", [10, 30, 45])
def test_corners_of_turned_images_are_no_data(turn_deg):
    turned = [rotate(speckle(), turn_deg, order=0) for _ in range(4)]
    with pytest.warns(SarsplatWarning, match="4 images of 4, the first 0.img, have zeros that reach from the corners"):
        made = imported([image(index, power) for index, power in enumerate(turned)])
    assert made.power.min() > 1e-5
    assert made.grid.rows * made.grid.columns > 0.3 * 64**2
    middle = np.unravel_index(made.power[0].argmax(), made.power[0].shape)
    assert abs(made.grid.range_m[middle[0]]) < 1 and abs(made.grid.azimuth_m[middle[1]]) < 1  # the origin stays


def test_a_band_without_data_is_cut_off():
    powers = [speckle() for _ in range(4)]
    powers[2][:, :6] = 0
    with pytest.warns(SarsplatWarning) as told:
        made = imported([image(index, power) for index, power in enumerate(powers)])
    assert "1 image of 4, the first 2.img, has zeros" in str(told[0].message)
    assert "64 × 58 pixels, by" in str(told[1].message)
    np.testing.assert_allclose(made.power[0] * made.source["mean_power"], powers[0][:, 6:], rtol=1e-5)


def test_thin_borders_are_cut_off_whatever_is_dark_inside():
    powers = [np.pad(speckle(), ((1, 0), (0, 2))) for _ in range(4)]
    with pytest.warns(SarsplatWarning, match="have zeros that reach from the corners"):
        assert imported([image(index, power) for index, power in enumerate(powers)]).power.shape == (4, 64, 64)


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
def test_dark_pixels_and_shadows_are_data():
    dark = [np.floor(speckle() * 0.6) for _ in range(4)]  # zeros everywhere, of pictures in few levels
    shadow = speckle()
    shadow[34:, 28:36] = 0  # beyond the target, to the edge
    for powers in (dark, [shadow] * 4):
        assert imported([image(index, power) for index, power in enumerate(powers)]).power.shape == (4, 64, 64)


def test_a_target_that_was_cut_out_is_refused_unless_it_is_said():
    rows, columns = np.mgrid[-32:32, -32:32]
    images = [image(index, speckle() * (np.hypot(rows, columns) < 15)) for index in range(4)]
    with pytest.raises(SarsplatError, match=r"83% of the pixels of 0.img are zeros .*ground=False"):
        imported(images)
    with pytest.warns(SarsplatWarning, match="raised to -30 dB"):
        assert imported(images, ground=False).power.shape == (4, 64, 64)


def test_one_picture_of_another_size_does_not_decide_for_all():
    images = [image(index, speckle(20, 24) if index == 3 else speckle()) for index in range(9)]
    with pytest.raises(SarsplatError, match=r"for 3.img \(20 × 24 pixels\) where 0.img has 64 × 64 pixels; remove"):
        imported(images)
    images[3] = image(3, speckle(60, 62))
    with pytest.warns(SarsplatWarning, match=r"cut to what they have in common, 60 × 62 pixels, by 3.img"):
        imported(images)


def test_halves_of_two_sizes_are_cut_to_the_smaller():
    with pytest.warns(SarsplatWarning, match="32 × 32 pixels"):
        imported([image(index, speckle(32, 32) if index % 2 else speckle()) for index in range(8)])


def test_a_spacing_of_another_unit_is_refused():
    images = [image(index, speckle(), 20.0 if index == 2 else 0.2) for index in range(6)]
    with pytest.raises(SarsplatError, match=r"2.img has pixels of 20 m × 20 m .* others of 0.2 m × 0.2 m; correct its"):
        imported(images)


def test_what_was_cut_off_is_said():
    powers = [np.clip(np.round(np.sqrt(speckle()) * 100), 1, 255) ** 2 for _ in range(4)]
    with pytest.warns(SarsplatWarning, match=r"of the pixels hold the largest value of their image, .* was cut off"):
        imported([image(index, power) for index, power in enumerate(powers)])
