"""Images of fewer, larger pixels: each is the mean power of a block of pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from sarsplat.geometry import ImageGrid


def multilooked(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], grid: ImageGrid, side: int
) -> tuple[Float[np.ndarray, "v rows columns"], ImageGrid]:
    """Means over blocks of `side` × `side` pixels, and where these lie; rows and columns that are left over go.

    A block's response is at least as wide as the block.
    """
    if side == 1:
        return power, grid
    rows, columns = grid.rows // side, grid.columns // side
    whole = power[:, : rows * side, : columns * side]
    blocks = whole.reshape(len(power), rows, side, columns, side).mean(axis=(2, 4))
    (azimuth, along), (across, down), finest = grid.center_m, grid.spacing_m, grid.resolution_m
    return blocks, replace(
        grid,
        rows=rows,
        columns=columns,
        spacing_m=(across * side, down * side),
        resolution_m=(max(finest[0], across * side), max(finest[1], down * side)),
        center_m=(
            azimuth - (grid.columns - columns * side) * across / 2,
            along - (grid.rows - rows * side) * down / 2,
        ),
    )
