"""Phoenix files: read as published, and believed only as far as the file reaches."""

from pathlib import Path

import numpy as np
import pytest

from chip_files import MAGNITUDE, phoenix_bytes
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR, Taylor
from sarsplat.importers import read_phoenix
from sarsplat.importers.pictures import read_pixels


@pytest.fixture
def path(tmp_path):
    return tmp_path / "HB03787.015"


def test_reads_magnitudes_and_header(path):
    path.write_bytes(phoenix_bytes())
    chip = read_phoenix(path)
    np.testing.assert_array_equal(chip.magnitude, MAGNITUDE)
    assert chip.magnitude.dtype == np.float32
    assert chip.magnitude.dtype.isnative
    assert (chip.target_type, chip.serial, chip.radar_position) == ("t72_tank", "132", "bottom")
    assert (chip.target_az_deg, chip.measured_depression_deg, chip.desired_depression_deg) == (10.790657, 17.09375, 17)
    assert chip.spacing_m == (0.203125, 0.202148)
    assert chip.resolution_m == (0.3229, 0.3013)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        (("-35dB_Taylor", "-35dB_Taylor"), TAYLOR),
        (("-30dB_Taylor", "-30dB_Taylor"), Taylor(30)),
        (("-35dB_Taylor", "-30dB_Taylor"), GAUSSIAN),
        (("-1e9dB_Taylor", "-1e9dB_Taylor"), GAUSSIAN),
        (("Hamming", "Hamming"), GAUSSIAN),
    ],
)
def test_the_header_states_the_response(path, stated, expected):
    path.write_bytes(phoenix_bytes(RangeWeighting=stated[0], CrossRangeWeighting=stated[1]))
    assert read_phoenix(path).response == read_phoenix(path).image.grid.response == expected
    path.write_bytes(phoenix_bytes())
    assert read_phoenix(path).response == GAUSSIAN


def test_a_chip_is_an_image(path):
    path.write_bytes(phoenix_bytes())
    image = read_phoenix(path).image
    np.testing.assert_allclose(image.power, MAGNITUDE[::-1, ::-1] ** 2, rtol=1e-6)  # row 0 near range
    np.testing.assert_allclose(image.signal, MAGNITUDE[::-1, ::-1] * np.exp(3j), rtol=1e-6)
    assert (image.view.azimuth_deg, image.view.grazing_deg) == (pytest.approx(349.209343), 17.09375)
    assert image.grid.spacing_m == (0.203125, 0.202148)


@pytest.mark.parametrize(
    ("original", "jpeg", "header", "correlation"),
    [
        ("BMP2_HB03787.000", "BMP2", ("bmp2_tank", "9563", 346.491974), 0.94),
        ("T72_HB03787.015", "T72", ("t72_tank", "132", 10.790657), 0.955),
    ],
)
def test_originals_against_their_jpegs(original, jpeg, header, correlation):
    """One reader against the other, where the JPEG does not saturate: pixel by pixel, and less its noise."""
    folder = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
    if not folder.is_dir():
        pytest.skip("the measured MSTAR chips are not here")
    from scipy.ndimage import uniform_filter

    chip = read_phoenix(folder / "phoenix" / original)
    assert (chip.target_type, chip.serial, chip.target_az_deg) == header
    published = read_pixels(folder / jpeg / "17deg" / "hb03787.jpeg")
    expected = np.minimum(chip.magnitude * 523.6, 255)  # as this set was scaled
    assert np.corrcoef(expected.ravel(), published.ravel())[0, 1] > correlation
    assert np.corrcoef(uniform_filter(expected, 3).ravel(), uniform_filter(published, 3).ravel())[0, 1] > 0.99
    assert expected.mean() == pytest.approx(published.mean(), rel=0.04)
