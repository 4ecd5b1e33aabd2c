"""Outlines of target and shadow in an image, from its decibels alone, whichever side is near range."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Real
from scipy.ndimage import label

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.radiometry import to_db
from sarsplat.regions.image_levels import above_ground_db, smoothed

_BRIGHT_DB, _DARK_DB = 3.0, -4.5  # limits of speckle above and below the ground, smoothed over a resolution cell, dB
_LARGE_PART = 0.2  # minimum weight of a connected part, relative to the largest
_RANGE_DB = 30.0  # dynamic range of images without ground, below the brightest pixel of a median image
_REACH = 1.0  # maximum distance of shadow from the target, in the target's extent along range


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
