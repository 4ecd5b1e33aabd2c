"""What images have in common: empty corners are no data, and one file does not decide for all."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import rotate

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import View
from sarsplat.importers import MeasuredImage, dataset_of

RNG = np.random.default_rng(0)


def image(index: int, power: np.ndarray, spacing: float = 0.2) -> MeasuredImage:
    return MeasuredImage(f"{index}.png", power.astype(np.float32), View(30.0 * index, 30.0), (spacing,) * 2, (0.3,) * 2)


def speckle(rows: int = 64, columns: int = 64) -> np.ndarray:
    power = RNG.exponential(size=(rows, columns))
    power[rows // 2 - 3 : rows // 2 + 3, columns // 2 - 3 : columns // 2 + 3] *= 100
    return power


def imported(images, **options):
    return dataset_of(images, target="thing", source={"kind": "made up"}, **options)


@pytest.mark.parametrize("turn_deg", [10, 30, 45])
def test_corners_of_turned_images_are_no_data(turn_deg):
    turned = [rotate(speckle(), turn_deg, order=0) for _ in range(4)]
    with pytest.warns(SarsplatWarning, match="4 images of 4, the first 0.png, have zeros that reach from the corners"):
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
    assert "1 image of 4, the first 2.png, has zeros" in str(told[0].message)
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
    with pytest.raises(SarsplatError, match=r"83% of the pixels of 0.png are zeros .*ground=False"):
        imported(images)
    with pytest.warns(SarsplatWarning, match="raised to -30 dB"):
        assert imported(images, ground=False).power.shape == (4, 64, 64)


def test_one_picture_of_another_size_does_not_decide_for_all():
    images = [image(index, speckle(20, 24) if index == 3 else speckle()) for index in range(9)]
    with pytest.raises(SarsplatError, match=r"for 3.png \(20 × 24 pixels\) where 0.png has 64 × 64 pixels; remove"):
        imported(images)
    images[3] = image(3, speckle(60, 62))
    with pytest.warns(SarsplatWarning, match=r"cut to what they have in common, 60 × 62 pixels, by 3.png"):
        imported(images)


def test_halves_of_two_sizes_are_cut_to_the_smaller():
    with pytest.warns(SarsplatWarning, match="32 × 32 pixels"):
        imported([image(index, speckle(32, 32) if index % 2 else speckle()) for index in range(8)])


def test_a_spacing_of_another_unit_is_refused():
    images = [image(index, speckle(), 20.0 if index == 2 else 0.2) for index in range(6)]
    with pytest.raises(SarsplatError, match=r"2.png has pixels of 20 m × 20 m .* others of 0.2 m × 0.2 m; correct its"):
        imported(images)


def test_what_was_cut_off_is_said():
    powers = [np.clip(np.round(np.sqrt(speckle()) * 100), 1, 255) ** 2 for _ in range(4)]
    with pytest.warns(SarsplatWarning, match=r"of the pixels hold the largest value of their image, .* was cut off"):
        imported([image(index, power) for index, power in enumerate(powers)])
