"""Speckle through the response: of power 1, exponential, and as alike in neighbours as the window says."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR
from sarsplat.scenes import mstar_grid
from sarsplat.scenes.scattering import ResponseSpeckle, white_speckle

GRID = ImageGrid(96, 128, (0.2, 0.25), (0.32, 0.3), response=TAYLOR)


def lag(power: np.ndarray, axis: int) -> float:
    """Correlation of the power of neighbours."""
    away = np.moveaxis(power - power.mean(), axis, -1)
    return float((away[..., 1:] * away[..., :-1]).mean() / (away**2).mean())


def expected(spacing_m: float, width_m: float) -> float:
    """From the window alone: the squared transform of its squares."""
    places = (np.arange(512) + 0.5) / 512 - 0.5
    window = TAYLOR.window(places)
    band = TAYLOR.width / width_m  # cycles per metre
    return float(((window**2 * np.cos(2 * np.pi * places * band * spacing_m)).sum() / (window**2).sum()) ** 2)


def test_neighbours_are_as_alike_as_the_window_says() -> None:
    speckle, rng = ResponseSpeckle(GRID), np.random.default_rng(0)
    drawn = np.stack([speckle.draw(rng) for _ in range(30)])
    assert drawn.dtype == np.complex64
    power = np.abs(drawn) ** 2
    assert power.mean() == pytest.approx(1, abs=0.01)
    assert power.std() == pytest.approx(1, abs=0.02)  # as exponential power has it
    assert abs((drawn**2).mean()) < 0.01  # all phases are as likely
    assert lag(power, 1) == pytest.approx(expected(0.25, 0.3), abs=0.015)
    assert lag(power, 2) == pytest.approx(expected(0.2, 0.32), abs=0.015)


def test_a_gaussian_response_correlates_as_a_gaussian() -> None:
    grid = ImageGrid(64, 64, (0.2, 0.2), (0.3, 0.3), response=GAUSSIAN)
    rng = np.random.default_rng(0)
    power = np.stack([np.abs(ResponseSpeckle(grid).draw(rng)) ** 2 for _ in range(40)])
    # h is a Gaussian of twice the variance of |h|²; its correlation of four times, and squared of twice
    assert lag(power, 1) == pytest.approx(2 ** -(2 * (0.2 / 0.3) ** 2), abs=0.02)


def test_white_speckle_is_white() -> None:
    power = np.abs(white_speckle((200, 300), np.random.default_rng(1))) ** 2
    assert power.mean() == pytest.approx(1, abs=0.02)
    assert abs(lag(power, 0)) < 0.02
    assert abs(lag(power, 1)) < 0.02


def test_of_measured_chips() -> None:
    """The public chips show .60 and .63, of which JPEG compression makes a part."""
    grid = mstar_grid()
    found = [expected(spacing, width) for spacing, width in zip(grid.spacing_m, grid.resolution_m, strict=True)]
    assert found == pytest.approx([0.52, 0.48], abs=0.02)
