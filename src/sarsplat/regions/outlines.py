"""Outlines of target and shadow, and levels of places on the ground, from images' decibels alone."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Real
from scipy.ndimage import label, map_coordinates

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.radiometry import to_db
from sarsplat.regions.target_box import above_ground_db, smoothed

_BRIGHT_DB, _DARK_DB = 3.0, -4.5
"""Limits of speckle above and below the ground, smoothed over a resolution cell, dB."""

_LARGE_PART = 0.2
"""Minimum weight of a connected part, relative to the largest."""

_RANGE_DB = 30.0
"""Dynamic range of images without ground, below the brightest pixel of a median image."""

_REACH = 1.0
"""Maximum distance of shadow from the target, in the target's extent along range."""

_SURE_DB = 3.0
"""Level above the ground that speckle does not reach, dB."""


@dataclass(frozen=True)
class Outline:
    """Masks of the target and of the shadow in one image; the shadow may be before or behind the target in range."""

    target: Bool[np.ndarray, "rows columns"]
    shadow: Bool[np.ndarray, "rows columns"]


def levels_db(
    power: Real[np.ndarray, "v rows columns"], grid: ImageGrid, ground: bool
) -> Float64[np.ndarray, "v rows columns"]:
    """Decibels above the ground, smoothed over a resolution cell; without ground, above the dynamic range's floor."""
    if ground:
        return above_ground_db(power, grid)
    smooth = smoothed(power, grid)
    peak = max(float(np.median(smooth.max(axis=(1, 2)))), np.finfo(float).tiny)
    return np.maximum(to_db(smooth, peak) + _RANGE_DB, 0.0)


def outline(level_db: Float64[np.ndarray, "rows columns"]) -> Outline:
    """Find target and shadow in one image of `levels_db`."""
    target = _large_parts(level_db > _BRIGHT_DB, np.maximum(level_db, 0))
    shadow = np.zeros_like(target)
    rows = np.flatnonzero(target.any(axis=1))
    if len(rows):
        reach = max(3, round(_REACH * (rows[-1] - rows[0] + 1)))
        near = np.zeros_like(target)
        near[max(0, rows[0] - reach) : rows[-1] + reach + 1, target.any(axis=0)] = True
        dark = (level_db < _DARK_DB) & near & ~target
        shadow = _large_parts(dark, np.maximum(-level_db, 0))
    return Outline(target, shadow)


def usual_gamma0(train: Dataset) -> float:
    """Median γ⁰ of the target's pixels, smoothed over a resolution cell; mean of all pixels without target."""
    smooth = smoothed(train.power, train.grid)
    gamma0 = np.stack([view.look.gamma0_of_beta0(image) for view, image in zip(train.views, smooth, strict=True)])
    target = np.stack([outline(level_db).target for level_db in levels_db(train.power, train.grid, train.ground)])
    return float(np.median(gamma0[target]) if target.any() else gamma0.mean())


def _large_parts(
    mask: Bool[np.ndarray, "rows columns"], by_db: Float64[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"]:
    """Connected parts of a mask with at least `_LARGE_PART` of the largest part's sum of `by_db`."""
    part, count = label(mask)
    if not count:
        return mask
    weight = np.bincount(part.ravel(), (mask * by_db).ravel(), count + 1)
    weight[0] = 0
    return (weight >= _LARGE_PART * weight.max())[part] & mask


def ground_levels_db(
    train: Dataset, x: Float64[np.ndarray, "rows columns"], y: Float64[np.ndarray, "rows columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Median level over the images at places on level ground, dB above the usual ground; 0 if uncertain.

    The median ignores objects on the ground, which each image shows elsewhere, except at their foot.
    """
    grid, levels = train.grid, []
    for level_db, view in zip(above_ground_db(train.power, train.grid), train.views, strict=True):
        azimuth, slant_range = np.tensordot(view.look.gradients[:, :2], np.stack([x, y]), 1)
        pixel = (slant_range - grid.range_m[0]) / grid.spacing_m[1], (azimuth - grid.azimuth_m[0]) / grid.spacing_m[0]
        levels.append(map_coordinates(level_db, pixel, order=1, mode="constant", cval=np.nan).astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place that no image shows
        middle = np.nanmedian(levels, axis=0)
    return np.where(middle > _SURE_DB, middle, 0.0).astype(np.float64)
