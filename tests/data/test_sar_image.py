"""One image in memory: what it takes, and its amplitude and decibels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sarsplat.data import SarImage
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(2, 3, (0.3, 0.3), (0.3, 0.3))
VIEW = View(0, 30)


def test_amplitude_and_decibels() -> None:
    power = np.array([[100, 1, 0], [4, 0.01, 1e-45]], np.float32)
    image = SarImage(power, VIEW, GRID)
    np.testing.assert_allclose(image.amplitude[0], [10, 1, 0])
    np.testing.assert_allclose(image.decibels[0], [20, 0, -np.inf])


@pytest.mark.parametrize(
    ("power", "told"),
    [
        ([[1.0, 1, 1], [1, 1, 1]], "the image is of list; give power as an array"),
        (np.ones((2, 3), complex), "the image is of complex128; give power as .*of complex ones"),
        (np.ones((3, 2)), r"shape \(3, 2\) but its grid has \(2, 3\)"),
        (np.array([[1, 1, 1], [1, -1, 1.0]]), "holds -1.0 at row 1, column 1"),
        (np.array([[1, 1, 1], [1, 1, np.nan]]), "holds nan at row 1, column 2"),
    ],
)
def test_what_is_no_power_is_refused(power: Any, told: str) -> None:
    with pytest.raises(SarsplatError, match=told):
        SarImage(power, VIEW, GRID)
