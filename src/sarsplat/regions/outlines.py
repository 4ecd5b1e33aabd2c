"""Outlines of target and shadow in an image, from its decibels alone, whichever side is near range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Real
from scipy.ndimage import label

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.radiometry import to_db
from sarsplat.regions.image_levels import above_ground_db, smoothed

_BRIGHT_DB, _DARK_DB = 3.0, -4.5
"""Above and below the ground: what is farther off, smoothed over a resolution cell, is not speckle."""

_LARGE_PART = 0.2
"""Parts that stand out count if they have this share of the largest."""

_RANGE_DB = 30.0
"""Images without ground: what is this far below the brightest of a median image counts as nothing."""

_REACH = 1.0
"""Shadow is looked for this far from the target, in the target's extent along range."""


@dataclass(frozen=True)
class Outline:
    """Outlines of target and shadow in one image."""

    target: Bool[np.ndarray, "rows columns"]
    shadow: Bool[np.ndarray, "rows columns"]
    """Where the target is, and where it is dark beside it along range, on whichever side; perhaps nowhere."""


def levels_db(
    power: Real[np.ndarray, "v rows columns"], grid: ImageGrid, ground: bool
) -> Float64[np.ndarray, "v rows columns"]:
    """Decibels above the ground, smoothed over a resolution cell; without ground, above what counts as nothing."""
    if ground:
        return above_ground_db(power, grid)
    smooth = smoothed(power, grid)
    peak = max(float(np.median(smooth.max(axis=(1, 2)))), np.finfo(float).tiny)
    return np.maximum(to_db(smooth, peak) + _RANGE_DB, 0.0)


def outline(level_db: Float64[np.ndarray, "rows columns"]) -> Outline:
    """Target and shadow of one image, of `levels_db`."""
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
    """Median γ⁰ of the pixels that stand out from the ground, smoothed over a resolution cell; of all if none do."""
    grid = train.grid
    smooth = smoothed(train.power, grid)
    gamma0 = np.stack([view.look.gamma0_of_beta0(image) for view, image in zip(train.views, smooth, strict=True)])
    shown = np.stack([outline(level_db).target for level_db in levels_db(train.power, grid, train.ground)])
    return float(np.median(gamma0[shown]) if shown.any() else gamma0.mean())


def _large_parts(
    standing_out: Bool[np.ndarray, "rows columns"], by_db: Float64[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"]:
    """The connected parts that have a good share of the one that stands out most."""
    part, count = label(standing_out)
    if not count:
        return standing_out
    weight = np.bincount(part.ravel(), (standing_out * by_db).ravel(), count + 1)
    weight[0] = 0
    return (weight >= _LARGE_PART * weight.max())[part] & standing_out
