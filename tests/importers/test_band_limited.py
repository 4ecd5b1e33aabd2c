"""Interpolation of band-limited images."""

import numpy as np
import pytest

from sarsplat.importers.band_limited import resample


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
