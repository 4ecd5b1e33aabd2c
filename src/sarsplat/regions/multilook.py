"""Multilooking of images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sarsplat.geometry import ImageGrid


def multilooked(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], grid: ImageGrid, factor: int
) -> tuple[Float[np.ndarray, "v rows columns"], ImageGrid]:
    """Means of power over blocks of factor × factor pixels, and where these lie (`ImageGrid.multilooked`)."""
    if factor == 1:
        return power, grid
    blocks = grid.multilooked(factor)
    whole = power[:, : blocks.rows * factor, : blocks.columns * factor]
    return whole.reshape(len(power), blocks.rows, factor, blocks.columns, factor).mean(axis=(2, 4)), blocks
