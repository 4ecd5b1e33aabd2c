"""What tells generated chips from measured ones, in numbers: of 8-bit magnitudes, each scaled by its own maximum."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.stats import wasserstein_distance

DARK = 2
"""Digital numbers up to this one are darkness."""

CLUTTER, TARGET, NEITHER = 0, 1, 3
"""Labels of pixels, as `Run.masks` has them, and for what lies between."""

_APART = 8
"""Pixels between clutter and what is target or shadow: side lobes are neither, nor is what a mask has missed."""

Chips = np.ndarray
"""uint8 [n, rows, columns], near range at the top."""

Masks = np.ndarray
"""uint8 [n, rows, columns]: 0 clutter, 1 target, 2 shadow."""


def apart(masks: Masks) -> Masks:
    """With clutter only where it is well away from target and shadow."""
    near = np.stack([binary_dilation(mask != CLUTTER, iterations=_APART) for mask in masks])
    return np.where(near & (masks == CLUTTER), np.uint8(NEITHER), masks)


def alike(chips: Chips, masks: Masks, axis: int) -> float:
    """Correlation of the power of neighbouring pixels, both clutter, along range (1) or azimuth (2)."""
    power, clutter = chips.astype(float) ** 2, masks == CLUTTER
    mean = (power * clutter).sum((1, 2), keepdims=True) / clutter.sum((1, 2), keepdims=True)
    away = np.where(clutter, power / mean - 1, 0.0)
    first, second = (np.take(array, range(array.shape[axis] - 1), axis) for array in (away, clutter))
    next_, also = (np.take(array, range(1, array.shape[axis]), axis) for array in (away, clutter))
    return float((first * next_).sum() / (second & also).sum() / (away**2).sum() * clutter.sum())


def bright_pixels(chips: Chips) -> float:
    """Pixels of a chip above half of its maximum."""
    return float((chips > 127).sum((1, 2)).mean())


def darkness(chips: Chips) -> float:
    """Share of pixels that are dark."""
    return float((chips <= DARK).mean())


def histogram_distance_db(chips: Chips, masks: Masks, others: Chips, their_masks: Masks, label: int) -> float:
    """How far apart the histograms of two sets' pixels of one kind are: the mean way of a pixel's level, dB."""
    levels = [
        20 * np.log10(np.maximum(pixels[where == label], DARK).astype(float))
        for pixels, where in ((chips, masks), (others, their_masks))
    ]
    return float(wasserstein_distance(*levels))


COLUMNS: dict[str, Callable[[Chips, Masks, Chips, Masks], float]] = {
    "alike in range": lambda chips, masks, *_: alike(chips, masks, 1),
    "alike in azimuth": lambda chips, masks, *_: alike(chips, masks, 2),
    "pixels above half": lambda chips, *_: bright_pixels(chips),
    f"share of DN ≤ {DARK}": lambda chips, *_: darkness(chips),
    "target's histogram (dB)": partial(histogram_distance_db, label=TARGET),
    "clutter's histogram (dB)": partial(histogram_distance_db, label=CLUTTER),
}
"""Statistics of a set and its masks, with those of the measured chips that it should be like."""
