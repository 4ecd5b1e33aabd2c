"""The box around what stands out from the ground in images of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import gaussian_filter, label, map_coordinates

from sarsplat.geometry import ImageGrid, View, radar_frame

_SURE_DB = 3.0
"""What is brighter than the ground by more is no speckle …"""

_PROBABLE = 2.5
"""… and what is connected to it and brighter by this many standard deviations of the ground belongs to it."""

_GLINT_DB = 12.0
"""What is darker than the bright part of the target by more may be the response of its glints."""

_BRIGHT_PART = 0.9
"""Share of the target that is darker than its bright part."""

_LARGE_PART = 0.2
"""Parts that stand out count if they have this share of the largest: few views show a target in pieces."""

_DARKEST_DB = -3.0
"""Below the ground: shadow may be darker, but it says no more than that."""

_HEIGHT = 0.65
"""Of the box, relative to its narrower side: views of one grazing angle hardly tell height from distance."""

_DEVIATION = 1.4826
"""Standard deviation of normal noise, in medians of its magnitude."""


def target_box(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Corners of the box, from the mean over all images of the decibels above the ground at each place of it.

    What stands on the ground is displaced towards the radar, to all sides in turn: the box has room for that.

    Parameters
    ----------
    power : numpy.ndarray [V, rows, columns]
        β⁰, linear power, of images that show the ground around the target. Their gains may differ.
    views, grid
        Where they were taken from, and where their pixels lie.

    Returns
    -------
    low, high : numpy.ndarray, float64 [3]
        World frame, m; z from 0 to two thirds of the narrower side. Where nothing stands out, the middle half of the
        scene.
    """
    half = _seen_by_all(views, grid)
    axis = np.linspace(-half, half, 2 * math.ceil(2 * half / grid.cell_m) + 1)
    above_db = _above_ground_db(power, views, grid, axis)
    sure = above_db > _SURE_DB
    low, high = np.full(2, -half / 2), np.full(2, half / 2)
    if sure.any():
        threshold_db = max(
            _PROBABLE * _DEVIATION * float(np.median(np.abs(above_db))),
            float(np.quantile(above_db[sure], _BRIGHT_PART)) - _GLINT_DB,
        )
        part, count = label(above_db > threshold_db)
        weight = np.bincount(part.ravel(), (sure * above_db).ravel(), count + 1)
        weight[0] = 0  # what does not stand out
        if weight.any():
            y, x = np.nonzero((weight >= _LARGE_PART * weight.max())[part])
            low, high = axis[[x.min(), y.min()]] - grid.cell_m, axis[[x.max(), y.max()]] + grid.cell_m
    return np.array([*low, 0.0]), np.array([*high, _HEIGHT * (high - low).min()])


def _seen_by_all(views: Sequence[View], grid: ImageGrid) -> float:
    """Radius of the largest disc of ground around the origin that lies in every image, m."""
    flattest = math.cos(math.radians(min(view.grazing_deg for view in views)))
    across = grid.columns * grid.spacing_m[0] / 2 - abs(grid.center_m[0])
    along = (grid.rows * grid.spacing_m[1] / 2 - abs(grid.center_m[1])) / flattest
    return min(across, along)


def _above_ground_db(
    power: Float[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    axis: Float64[np.ndarray, " side"],
) -> Float64[np.ndarray, "side side"]:
    """Mean over the images of the decibels above each one's median, at each place on the ground; row 0 at the least y.

    The median of the whole is 0.
    """
    x, y = np.meshgrid(axis, axis)
    places = np.stack([x, y, np.zeros_like(x)], axis=-1)
    # one cell wide, each way: speckle is smoothed, and what is larger stays
    width = (0.0, grid.resolution_m[1] / grid.spacing_m[1], grid.resolution_m[0] / grid.spacing_m[0])
    smooth = gaussian_filter(power.astype(np.float64), width, mode="nearest")
    ground = np.median(smooth, axis=(1, 2), keepdims=True)
    darkest = 10 ** (_DARKEST_DB / 10)
    level_db = 10 * np.log10(np.maximum(smooth / np.maximum(ground, np.finfo(float).tiny), darkest))
    total = np.zeros_like(x)
    for image, view in zip(level_db, views, strict=True):
        across, _, along = np.moveaxis(places @ radar_frame(view).T, -1, 0)
        row = (along - grid.range_m[0]) / grid.spacing_m[1]
        column = (across - grid.azimuth_m[0]) / grid.spacing_m[0]
        total += map_coordinates(image, [row, column], order=1, mode="nearest")
    mean = total / len(views)
    return mean - np.median(mean)
