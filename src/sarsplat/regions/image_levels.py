"""Levels of images above their ground, smoothed, and at places in space or on the ground."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import gaussian_filter, map_coordinates

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import LEAST_POWER, to_db

_QUARTER = 0.6373  # width of the narrowest interval that holds a quarter of normal noise, in standard deviations
_SURE_DB = 3.0  # minimum level of bright ground, dB above the usual ground; less is speckle


def seen_by_all(views: Sequence[View], grid: ImageGrid) -> float:
    """Return the radius of the largest disc around the origin that lies in every image, m; ≤ 0 without any."""
    across, along = (
        count * spacing / 2 - abs(middle)
        for count, spacing, middle in zip((grid.columns, grid.rows), grid.spacing_m, grid.center_m, strict=True)
    )
    return min(view.look.disc_m(across, along) for view in views)


def above_ground_db(
    power: Float[np.ndarray, "v rows columns"], grid: ImageGrid
) -> Float64[np.ndarray, "v rows columns"]:
    """Return decibels above each image's ground, smoothed over a resolution cell; `power` is linear."""
    smooth = smoothed(power, grid)
    level_db = to_db(smooth, np.maximum(np.median(smooth, axis=(1, 2), keepdims=True), LEAST_POWER))
    return level_db - np.array([typical(image)[0] for image in level_db])[:, None, None]


def smoothed(power: Float[np.ndarray, "v rows columns"], grid: ImageGrid) -> Float64[np.ndarray, "v rows columns"]:
    """Smooth images over a resolution cell each way, at most over the whole image."""
    across, away = np.divide(grid.resolution_m, grid.spacing_m)
    return gaussian_filter(power.astype(np.float64), np.minimum((0.0, away, across), power.shape), mode="nearest")


def values_at(
    image: Float[np.ndarray, "rows columns"], view: View, grid: ImageGrid, places: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n"]:
    """Return an image's values, linearly interpolated, where it shows places (x, y, z; m); NaN outside of it."""
    first, spacing = np.array([grid.range_m[0], grid.azimuth_m[0]]), np.array(grid.spacing_m[::-1])
    pixels = (places @ view.look.gradients[[1, 0]].T - first) / spacing
    return map_coordinates(image, np.moveaxis(pixels, -1, 0), order=1, mode="constant", cval=np.nan)


def typical(values: Float64[np.ndarray, ...]) -> tuple[float, float]:
    """Return centre and standard deviation of normal noise, from the shortest interval with a quarter of the values.

    Values that are not finite are ignored, and so are the least and the largest, which may be clipped.
    """
    known = np.sort(values[np.isfinite(values)])
    between = known[(known > known[0]) & (known < known[-1])]
    known = between if len(between) else known
    count = len(known) // 4
    width = known[count:] - known[: len(known) - count]
    first = int(width.argmin())
    return float(known[first] + width[first] / 2), float(width[first]) / _QUARTER


def ground_levels_db(
    train: Dataset, x: Float64[np.ndarray, "ny nx"], y: Float64[np.ndarray, "ny nx"]
) -> Float64[np.ndarray, "ny nx"]:
    """Return the median level over the images at places on level ground (m), dB above the usual ground; 0 if speckle.

    Objects are displaced differently in each image, so the median is high only where the ground is bright or under a
    bright object.
    """
    places = np.stack([x, y, np.zeros_like(x)], axis=-1)
    levels_db = above_ground_db(train.power, train.grid)
    shown = [values_at(image, view, train.grid, places) for image, view in zip(levels_db, train.views, strict=True)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place that no image shows
        middle = np.nanmedian(shown, axis=0)
    return np.where(middle > _SURE_DB, middle, 0.0).astype(np.float64)
