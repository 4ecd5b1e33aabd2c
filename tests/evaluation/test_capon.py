"""Capon's method, for comparison."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.evaluation.capon import capon_points
from sarsplat.geometry import ImageGrid, Stack, View

GRID = ImageGrid(9, 9, (0.3, 0.3), (0.3, 0.3))
VIEW = View(0.0, 45.0)
STACK = Stack(0.031, tuple(np.linspace(0, 0.008, 5)))


@pytest.mark.parametrize("background", [0.0, 1e-5])
def test_a_scatterer_is_found_and_dark_pixels_have_no_points(background: float) -> None:
    """Without noise, pixels beside the scatterer hold nothing, or rounding."""
    height_m = 1.5
    phases = STACK.elevation_numbers(VIEW) * (height_m / VIEW.look.height_per_elevation)
    signal = np.full((1, 5, 9, 9), background, np.complex64) * np.exp(1j * STACK.plane_phases(VIEW, GRID))[None]
    signal[0, :, 4, 4] = 3 * np.exp(1j * (STACK.plane_phases(VIEW, GRID)[:, 4, 4] + phases))
    entry = DatasetEntry(VIEW, "train", "v0", stack=STACK)
    points = capon_points(Dataset.of_complex(GRID, (entry,), signal.astype(np.complex64)), -1.0, 4.0)
    assert np.isfinite(points).all()
    assert 1 <= len(points) <= 9  # what 3 × 3 pixels average
    np.testing.assert_allclose(points[:, 2], height_m, atol=0.1)
