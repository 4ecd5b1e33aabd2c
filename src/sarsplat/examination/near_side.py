"""Which side of the images is near range, from each image: shadow beyond the target, and a bright near edge."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.fft import irfft2, next_fast_len, rfft2

from sarsplat.examination.significance import SideEvidence
from sarsplat.regions.outlines import Outline

_BRIGHT_DB, _BRIGHTEST_DB = 3.0, 23.0
"""Above the ground: from where on something stands out from speckle, and where its brightness says no more."""

_DARKEST_DB = -10.0
"""Below the ground: what is darker says no more."""

_PIXELS = 256
"""Most on a side in the search for shadow: larger images are averaged."""


def shadow_sides(levels: Float64[np.ndarray, "v rows columns"]) -> SideEvidence:
    """For each side as near range: how much darker than the ground it is behind the bright target, dB.

    Beyond is the quadrant around the direction away from that side, as far as half the shorter side of the images. All
    distances count the same, and bright pixels by their decibels.

    Parameters
    ----------
    levels : numpy.ndarray, float64 [V, rows, columns]
        Decibels above the ground, of images that show it.
    """
    step = math.ceil(max(levels.shape[1:]) / _PIXELS)
    rows, columns = (pixels // step for pixels in levels.shape[1:])
    padded = next_fast_len(2 * rows), next_fast_len(2 * columns)
    down, right = np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in padded), indexing="ij")
    distance = np.hypot(down, right)
    weight = np.where((distance > 0) & (distance <= min(rows, columns) / 2), 1 / np.maximum(distance, 1.0), 0.0)
    beyond = (down > abs(right), -right > abs(down), -down > abs(right), right > abs(down))  # of top, right …
    quadrants = [rfft2(weight * where) for where in beyond]
    darkness = []
    for level in levels:
        bright = rfft2(_coarse(np.clip(level - _BRIGHT_DB, 0.0, _BRIGHTEST_DB - _BRIGHT_DB), step), padded)
        dark = _coarse(np.clip(-level, 0.0, -_DARKEST_DB), step)
        reached = [irfft2(bright * quadrant, padded)[:rows, :columns] for quadrant in quadrants]
        if bright[0, 0].real > 0 and min(share.sum() for share in reached) > 0:
            darkness.append([float((share * dark).sum() / share.sum()) for share in reached])
    return SideEvidence(np.array(darkness).reshape(-1, 4))


def _coarse(image: Float64[np.ndarray, "rows columns"], step: int) -> Float64[np.ndarray, "m n"]:
    """Means of squares of pixels; what is left over at the ends is left out."""
    rows, columns = (pixels // step for pixels in image.shape)
    return image[: rows * step, : columns * step].reshape(rows, step, columns, step).mean(axis=(1, 3))


def edge_sides(levels: Float64[np.ndarray, "v rows columns"], outlines: Sequence[Outline]) -> SideEvidence:
    """Skewness of the target's amplitude, summed over lines along each side, away from it.

    It is positive if the target has a bright edge on that side, and a long tail beyond it.

    Parameters
    ----------
    levels : numpy.ndarray, float64 [V, rows, columns]
        Decibels above the ground, or above what counts as nothing.
    outlines : sequence of Outline
        Of the same images.
    """
    targets = np.array([outline.target for outline in outlines])
    amplitude = np.where(targets, 10 ** (levels / 20), 0.0)
    amplitude = amplitude[amplitude.any(axis=(1, 2))]
    down, right = _skewness(amplitude.sum(axis=2)), _skewness(amplitude.sum(axis=1))
    return SideEvidence(np.stack([down, -right, -down, right], axis=1))


def _skewness(profiles: Float64[np.ndarray, "v n"]) -> Float64[np.ndarray, " v"]:
    place = np.arange(profiles.shape[1], dtype=float)
    share = profiles / profiles.sum(axis=1, keepdims=True)
    off = place - (share @ place)[:, None]
    spread = np.maximum((share * off**2).sum(axis=1), 1e-9)
    return (share * off**3).sum(axis=1) / spread**1.5
