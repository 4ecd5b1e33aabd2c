"""Crop of a raster to known heights: reprojected rasters have wedges without heights along their edges."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from sarsplat.errors import SarsplatError, SarsplatWarning, counted


def known_part(path: Path, heights: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "fewer less"]:
    """Return the largest part with the same middle and without NaN.

    Raises
    ------
    SarsplatError
        If NaNs form a hole inside, or fewer than 2 × 2 heights are left.

    Warns
    -----
    SarsplatWarning
        If something is cut off.
    """
    unknown = np.isnan(heights)
    if not unknown.any():
        return heights
    holes = holes_of(unknown)
    rows, columns = _margins(unknown)
    part = heights[rows : len(heights) - rows, columns : heights.shape[1] - columns]
    if holes.any() or min(part.shape) < 2:
        holes = holes if holes.any() else unknown
        (first, last), (left, right) = ((int(at.min()) + 1, int(at.max()) + 1) for at in np.nonzero(holes))
        many = int(holes.sum())
        raise SarsplatError(
            f"{path} has {counted(many, 'unknown height')} of {heights.size}, within rows {first} to {last} and "
            f"columns {left} to {right}; fill them in, as by gdal_fillnodata, or cut them off"
        )
    warnings.warn(
        f"{path} has {counted(int(unknown.sum()), 'unknown height')} of {heights.size} at its edges; it is cut by "
        f"{counted(rows, 'row')} above and below and {counted(columns, 'column')} left and right, and its new edges "
        "are continued outwards",
        SarsplatWarning,
        stacklevel=4,
    )
    return part


def holes_of(unknown: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Return the unknown heights that are not connected to an edge."""
    from scipy.ndimage import label  # slow to import, and rarely needed

    parts, _ = label(unknown, np.ones((3, 3)))
    edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return unknown & ~np.isin(parts, edges)


def _margins(unknown: Bool[np.ndarray, "rows columns"]) -> tuple[int, int]:
    """Return the rows and columns to cut off on both sides, so that the largest known part is left."""
    rows, columns = unknown.shape
    row, column = np.nonzero(unknown)
    deepest = np.zeros((rows + 1) // 2 + 1, np.int64)  # columns to cut, by how many rows are
    np.maximum.at(deepest, np.minimum(row, rows - 1 - row), np.minimum(column, columns - 1 - column) + 1)
    deepest = np.maximum.accumulate(deepest[::-1])[::-1]
    area = np.maximum(rows - 2 * np.arange(len(deepest)), 0) * np.maximum(columns - 2 * deepest, 0)
    best = int(area.argmax())
    return best, int(deepest[best])
