"""Target and shadow in a SAR image of a vehicle on open ground, and how far two images agree about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, label, shift

SIGMA = 1.5  # pixels: the despeckling filter
FRAME = 12  # pixels along the chip's edges that show nothing but ground
# Fixed by the ground alone: of the measured chips' frames one filtered pixel in a hundred is brighter than 3 × their
# median, and one in a hundred darker than 0.35 × it.
BRIGHT, DARK = 3.0, 0.35
REACH = 10  # pixels: a shadow starts no farther from the target, whose far side may be dim


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


def despeckled(power: np.ndarray) -> np.ndarray:
    """Power behind a Gaussian filter, over the median of the ground's: the pixels of the frame."""
    smooth = gaussian_filter(np.asarray(power, dtype=np.float64), SIGMA)
    ground = np.ones(smooth.shape, dtype=bool)
    ground[FRAME:-FRAME, FRAME:-FRAME] = False
    return smooth / np.median(smooth[ground])


def outline(power: np.ndarray) -> Outline:
    """Target: the largest connected area above `BRIGHT`. Shadow: the largest below `DARK` within `REACH` of it."""
    level = despeckled(power)
    target = _largest(level > BRIGHT)
    return Outline(target, _largest(level < DARK, binary_dilation(target, iterations=REACH)))


def _largest(mask: np.ndarray, touching: np.ndarray | None = None) -> np.ndarray:
    """The largest connected component of a mask, among those that touch another mask; empty if there is none."""
    components, _ = label(mask)
    allowed = components if touching is None else np.where(np.isin(components, components[touching]), components, 0)
    sizes = np.bincount(allowed.ravel())[1:]
    return allowed == sizes.argmax() + 1 if sizes.size and sizes.max() else np.zeros(mask.shape, dtype=bool)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))
