"""The part of a raster around its middle in which every height is known.

Rasters that were brought from one system into another have wedges without heights along their edges.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from sarsplat.errors import SarsplatError, SarsplatWarning, counted


def known_part(path: Path, heights: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "fewer less"]:
    """The largest part with the same middle in which nothing is NaN.

    Raises
    ------
    SarsplatError
        If what is not known does not reach in from an edge, or leaves fewer than 2 × 2 heights.

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
            f"{path} has {counted(many, 'height')} of {heights.size} that {'is' if many == 1 else 'are'} not known, "
            f"within rows {first} to {last} and columns {left} to {right}; fill them in, as by gdal_fillnodata, or cut "
            "them off"
        )
    warnings.warn(
        f"{path} has {counted(int(unknown.sum()), 'height')} of {heights.size} at its edges that are not known; it is "
        f"cut by {counted(rows, 'row')} above and below and {counted(columns, 'column')} left and right, beyond which "
        "the ground goes on as high as there",
        SarsplatWarning,
        stacklevel=4,
    )
    return part


def holes_of(unknown: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """What of it does not hang together with an edge."""
    from scipy.ndimage import label  # which takes long to import, and is rarely needed

    parts, _ = label(unknown, np.ones((3, 3)))
    edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return unknown & ~np.isin(parts, edges)


def _margins(unknown: Bool[np.ndarray, "rows columns"]) -> tuple[int, int]:
    """Rows and columns to cut off on both sides, so that all that is left is known and as much as can be is."""
    rows, columns = unknown.shape
    row, column = np.nonzero(unknown)
    deepest = np.zeros((rows + 1) // 2 + 1, np.int64)  # columns to cut, by how many rows are
    np.maximum.at(deepest, np.minimum(row, rows - 1 - row), np.minimum(column, columns - 1 - column) + 1)
    deepest = np.maximum.accumulate(deepest[::-1])[::-1]
    left = np.maximum(rows - 2 * np.arange(len(deepest)), 0) * np.maximum(columns - 2 * deepest, 0)
    best = int(left.argmax())
    return best, int(deepest[best])
