"""Target and shadow in a SAR image of a vehicle on open ground, and how far two images agree about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, label, median_filter, shift

FRAME = 12  # pixels along the chip's edges that show nothing but ground
REACH = 10  # pixels: a shadow starts no farther from the target, whose far side may be dim

Filter = Callable[[np.ndarray], np.ndarray]
GAUSSIAN: Filter = partial(gaussian_filter, sigma=1.5)  # pixels
FILTERS: dict[str, Filter] = {
    "Gaussian, σ = 1.5": GAUSSIAN,
    "median, 5 × 5": partial(median_filter, size=5),
    "median, 7 × 7": partial(median_filter, size=7),
}


@dataclass(frozen=True)
class Rule:
    """Rule for outlines: a despeckling filter, and levels over the ground's median."""

    smooth: Filter
    bright: float
    dark: float

    @classmethod
    def passing(cls, smooth: Filter, share: float, chips: np.ndarray) -> Rule:
        """The rule whose levels are passed by this share of the chips' frames, which show ground alone."""
        ground = np.concatenate([despeckled(power, smooth)[_frame(power)] for power in chips])
        return cls(smooth, float(np.quantile(ground, 1 - share)), float(np.quantile(ground, share)))


# Fixed by the ground alone: of the measured chips' frames one filtered pixel in a hundred is brighter than 3 × their
# median, and one in a hundred darker than 0.35 × it.
RULE = Rule(GAUSSIAN, bright=3.0, dark=0.35)


@dataclass(frozen=True)
class Outline:
    """Masks, bool [rows, columns], of the target and of its shadow."""

    target: np.ndarray
    shadow: np.ndarray

    def centred(self) -> Outline:
        """Both masks moved by whole pixels so that the target's centroid lies in the middle of the chip."""
        middle = (np.array(self.target.shape) - 1) / 2
        by = np.round(middle - np.argwhere(self.target).mean(axis=0))
        return Outline(*(shift(mask.astype(np.uint8), by, order=0).astype(bool) for mask in (self.target, self.shadow)))


def despeckled(power: np.ndarray, smooth: Filter = GAUSSIAN) -> np.ndarray:
    """Power behind a filter, over the median of the ground's: the pixels of the frame."""
    level = smooth(np.asarray(power, dtype=np.float64))
    return level / np.median(level[_frame(power)])


def outline(power: np.ndarray, rule: Rule = RULE) -> Outline:
    """Target: the largest connected area that is bright. Shadow: the largest dark one within `REACH` of it."""
    level = despeckled(power, rule.smooth)
    target = _largest(level > rule.bright)
    return Outline(target, _largest(level < rule.dark, binary_dilation(target, iterations=REACH)))


def _frame(power: np.ndarray) -> np.ndarray:
    frame = np.ones(power.shape, dtype=bool)
    frame[FRAME:-FRAME, FRAME:-FRAME] = False
    return frame


def _largest(mask: np.ndarray, touching: np.ndarray | None = None) -> np.ndarray:
    """Largest connected component of a mask, among those that touch another mask; empty if no component does."""
    components, _ = label(mask)
    allowed = components if touching is None else np.where(np.isin(components, components[touching]), components, 0)
    sizes = np.bincount(allowed.ravel())[1:]
    return allowed == sizes.argmax() + 1 if sizes.size and sizes.max() else np.zeros(mask.shape, dtype=bool)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))
