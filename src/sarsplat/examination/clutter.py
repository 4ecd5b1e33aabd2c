"""Statistics of clutter and sharpness, which tell the unit, the number of looks and the resolution of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real, Shaped
from scipy.ndimage import binary_dilation

from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import width_of
from sarsplat.radiometry import brighter
from sarsplat.regions.outlines import Outline

_CELLS_PER_BLOCK, _SMALLEST_BLOCK = 6, 8
"""Side of the blocks of clutter, in resolution widths and in pixels: ground hardly changes within one."""

_BLOCKS_PER_SIDE = 4
"""Of an image at least, if that is large enough: the resolution stated may be far too coarse."""

_FEWEST_BLOCKS = 20
_WHITE = 0.1
"""Neighbouring pixels of speckle that correlate less are taken as drawn independently of each other."""

_BRIGHT_DB = 25.0
"""Below the brightest of an image: what is darker is not looked at for its sharpness."""

_SHARPEST = 0.9999
"""Quantile of curvatures: that of the sharpest structure, but not of a single pixel."""


@dataclass(frozen=True)
class Clutter:
    """What blocks of ground look like, away from target and shadow.

    Attributes
    ----------
    contrast : float
        Standard deviation over mean, the median of all blocks.
    skewness : numpy.ndarray, float64 [blocks]
        Of each block's amplitude: positive for speckle, negative if decibels were read as power or amplitude.
    values : float
        Number of different values in a block, the median of all: few if pixels are quantised coarsely.
    width_m : (float or None, float or None)
        3 dB width in azimuth and slant range of the response that correlates neighbouring pixels of speckle so much;
        None if they hardly do.
    """

    contrast: float
    skewness: Float64[np.ndarray, " blocks"]
    values: float
    width_m: tuple[float | None, float | None]


def clutter(
    power: Real[np.ndarray, "v rows columns"],
    levels: Float64[np.ndarray, "v rows columns"],
    outlines: Sequence[Outline],
    grid: ImageGrid,
) -> Clutter | None:
    """Statistics of the ground around the target; None if too little of it is seen.

    Parameters
    ----------
    power, levels : numpy.ndarray [V, rows, columns]
        Linear power, and decibels above the ground.
    outlines : sequence of Outline
        Target and shadow of the same images.
    grid : ImageGrid
        Where the pixels lie.
    """
    across, along = (
        max(_SMALLEST_BLOCK, min(math.ceil(_CELLS_PER_BLOCK * width / spacing), pixels // _BLOCKS_PER_SIDE))
        for width, spacing, pixels in zip(grid.resolution_m, grid.spacing_m, (grid.columns, grid.rows), strict=True)
    )
    parts = []
    for image, level, outline in zip(power, levels, outlines, strict=True):
        other = binary_dilation(outline.target | outline.shadow | (np.abs(level) > 6.0))
        blocks = _blocks(image, along, across)
        parts.append(blocks[(blocks.mean(axis=(1, 2)) > 0) & ~_blocks(other, along, across).any(axis=(1, 2))])
    blocks = np.concatenate(parts).astype(np.float64)
    if len(blocks) < _FEWEST_BLOCKS:
        return None
    rest = _standardised(blocks)
    pixels = np.sort(blocks.reshape(len(blocks), -1), axis=1)
    neighbours = (rest[:, :, 1:] * rest[:, :, :-1], rest[:, 1:] * rest[:, :-1])
    widths = [
        _response_width(float(products.mean()), spacing)
        for products, spacing in zip(neighbours, grid.spacing_m, strict=True)
    ]
    return Clutter(
        float(np.median(blocks.std(axis=(1, 2), ddof=1) / blocks.mean(axis=(1, 2)))),
        (_standardised(np.sqrt(blocks)) ** 3).mean(axis=(1, 2)),
        float(np.median(1 + (np.diff(pixels, axis=1) > 0).sum(axis=1))),
        (widths[0], widths[1]),
    )


def _standardised(blocks: Float64[np.ndarray, "n along across"]) -> Float64[np.ndarray, "n along across"]:
    """Each block with mean 0 and standard deviation 1; 0 if it is constant."""
    rest = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    return rest / np.maximum(blocks.std(axis=(1, 2), keepdims=True), np.finfo(float).tiny)


def _blocks(image: Shaped[np.ndarray, "rows columns"], along: int, across: int) -> Shaped[np.ndarray, "n along across"]:
    """An image cut into blocks; what is left over at its ends is left out."""
    rows, columns = (pixels // side for pixels, side in zip(image.shape, (along, across), strict=True))
    cut = image[: rows * along, : columns * across].reshape(rows, along, columns, across)
    return cut.swapaxes(1, 2).reshape(-1, along, across)


def _response_width(correlation: float, spacing_m: float) -> float | None:
    """3 dB width of a Gaussian response, from the correlation of speckle power, which is √2 times as wide."""
    if not _WHITE < correlation < 1:
        return None
    return spacing_m * math.sqrt(2 * math.log(2) / -math.log(correlation))


def contrast_of(looks: float) -> tuple[float, float]:
    """Standard deviation over mean of speckle of so many looks: of power, and of amplitude."""
    ratio = math.exp(math.lgamma(looks) + math.lgamma(looks + 1) - 2 * math.lgamma(looks + 0.5))
    return 1 / math.sqrt(looks), math.sqrt(ratio - 1)


def sharpest_widths_m(power: Real[np.ndarray, "v rows columns"], grid: ImageGrid) -> tuple[float, float] | None:
    """3 dB widths in azimuth and slant range of the sharpest structure in images without speckle, m.

    However scatterers lie, the logarithm of a sum of Gaussian responses is nowhere curved more than that of one. None
    if there is nothing to look at.
    """
    peak = power.max(axis=(1, 2), keepdims=True)
    bright = brighter(power, -_BRIGHT_DB, peak) & (power > 0)
    logarithm = np.log(np.where(bright, power, 1.0), dtype=np.float64)
    widths = []
    for axis, spacing in zip((2, 1), grid.spacing_m, strict=True):
        values, shown = np.moveaxis(logarithm, axis, 2), np.moveaxis(bright, axis, 2)
        curvature = (2 * values[..., 1:-1] - values[..., 2:] - values[..., :-2]) / spacing**2
        curvature = curvature[shown[..., 1:-1] & shown[..., 2:] & shown[..., :-2]]
        most = float(np.quantile(curvature, _SHARPEST)) if len(curvature) else 0.0
        if not most > 0:
            return None
        widths.append(width_of(1 / most))
    return widths[0], widths[1]
