"""Checks of single values that would set the scale of all others: hot pixels and lines, and impossible dynamic ranges.

The response spreads any point target over its neighbours, so that the brightest of these is no darker than the response
one pixel from its peak. Speckle adds to that: among N independent pixels of one look, one exceeds all eight neighbours
t times with a probability below 8! N / t⁸. A Gaussian response represents any of its width, also an unweighted one,
whose zeros lie on the neighbours of pixels at the largest spacing: a point then exceeds these only by its offset from
the middle of its pixel.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.examination.outcome import Examination
from sarsplat.examination.significance import CHANCE
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Gaussian
from sarsplat.radiometry import bright_level, to_db

MAX_RANGE_DB = 100.0
"""Maximum ratio of the brightest pixel to the ground: above that of any radar."""

UNIT_RANK = 5
"""Rank of the pixel by which a range shows a wrong unit rather than hot pixels."""

_LINE_DB = 10.0  # tolerance of the difference between medians of neighbouring rows or columns, besides the response
_SINC_WIDTH = 0.8859  # 3 dB width of the unweighted response, relative to the distance of its peak from its first zero

_MIN_LINES = 3
_MIN_IMAGES = 3


def examine_single_values(dataset: Dataset, examined: Examination) -> bool:
    """Add contradictions of pixels and lines that no response produces, and impossible ranges; return True if any.

    If most images have an impossible range, and not by a few pixels, their unit is wrong: see `examine_units`.
    """
    if 2 * (ranges_db(dataset, UNIT_RANK) > MAX_RANGE_DB).sum() > len(dataset):
        return False
    bright = bright_level(dataset.power)
    # speckle of one look exceeds this ratio to all eight neighbours in one of the pixels with `CHANCE`
    speckle_db = 10 / 8 * math.log10(math.factorial(8) * dataset.power.size / CHANCE)
    limit_db = _point_db(dataset.grid) + speckle_db
    peaks = [peak for k, image in enumerate(dataset.power) for peak in _peaks(image, k, bright, limit_db)]
    wrong = _hot_pixels(peaks, dataset)
    wrong += _wide_ranges(dataset, {peak.index for peak in peaks})
    wrong += _lines(dataset, bright)
    examined.conclude("single values", wrong, "no pixel, row or column is too bright to be an echo")
    return bool(wrong)


def _hot_pixels(peaks: Sequence[_Peak], dataset: Dataset) -> list[str]:
    if not peaks:
        return []
    worst = max(peaks, key=lambda peak: peak.lead_db)
    images = counted(len({peak.index for peak in peaks}), "image")
    return [
        f"{counted(len(peaks), 'pixel')} of {images} {'stands' if len(peaks) == 1 else 'stand'} alone, such as row "
        f"{worst.row}, column {worst.column} of {dataset.entries[worst.index].name}, {worst.lead_db:.0f} dB above all "
        f"of its neighbours, where a point of the stated resolution is {_point_db(dataset.grid):.0f} dB above them; a "
        "hot pixel sets the scale of all others, so replace it by the mean of its neighbours, or correct the "
        "resolution if it is an echo"
    ]


def _floors(dataset: Dataset) -> Float64[np.ndarray, " v"]:
    """Return the power of each image's ground; without ground, the second brightest peak of all images."""
    if dataset.ground:
        return np.maximum(np.median(dataset.power, axis=(1, 2)).astype(np.float64), np.finfo(np.float32).tiny)
    peaks = np.sort(dataset.power.max(axis=(1, 2)))
    floor = float(peaks[-2]) if len(peaks) >= _MIN_IMAGES else float(peaks[-1])
    return np.full(len(dataset), max(floor, np.finfo(np.float32).tiny))


def ranges_db(dataset: Dataset, rank: int = 1) -> Float64[np.ndarray, " v"]:
    """Return the ratio of each image's brightest pixel, or of that of another rank, to the ground, dB."""
    rank = min(rank, dataset.power[0].size)
    brightest = [np.partition(image, -rank, axis=None)[-rank] for image in dataset.power]  # one by one, for memory
    return np.asarray(to_db(np.array(brightest), _floors(dataset)))


def _wide_ranges(dataset: Dataset, hot_images: Collection[int]) -> list[str]:
    """Describe images whose brightest pixel is impossibly bright, except those with hot pixels."""
    ranges = ranges_db(dataset)
    ranges[[*hot_images]] = 0.0
    wide = np.flatnonzero(ranges > MAX_RANGE_DB)
    if not len(wide):
        return []
    worst = int(wide[ranges[wide].argmax()])
    row, column = np.unravel_index(int(dataset.power[worst].argmax()), dataset.power[worst].shape)
    above = "its ground" if dataset.ground else "that of any other image"
    others = f" (so in {counted(len(wide), 'image')})" if len(wide) > 1 else ""
    return [
        f"the brightest pixel of {dataset.entries[worst].name}, row {row}, column {column}, is {ranges[worst]:.0f} dB "
        f"above {above}{others}, more than any radar image has; correct that pixel, which sets the scale"
    ]


@dataclass(frozen=True)
class _Peak:
    """A pixel that is brighter than its neighbours."""

    index: int
    row: int
    column: int
    lead_db: float


def _peaks(image: Real[np.ndarray, "rows columns"], index: int, bright: float, limit_db: float) -> list[_Peak]:
    """Find the bright pixels of an image that exceed all of their neighbours by more than the limit."""
    rows, columns = np.nonzero(image >= bright)
    padded = np.pad(image, 1)
    down, right = np.transpose([(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)])
    neighbours = padded[rows[:, None] + down, columns[:, None] + right].astype(np.float64)
    beside = neighbours.max(axis=1, initial=_typical_power(image))
    leads = to_db(image[rows, columns], beside)
    return [
        _Peak(index, int(row), int(column), float(lead))
        for row, column, lead in zip(rows, columns, leads, strict=True)
        if lead > limit_db
    ]


def _typical_power(image: Real[np.ndarray, "rows columns"]) -> float:
    """Return the mean power without the brightest tenth: with coarse quantisation, medians jump."""
    dark = image[image <= np.quantile(image, 0.9)].mean(dtype=np.float64)
    return max(float(dark), float(np.finfo(np.float32).tiny))


def _point_db(grid: ImageGrid) -> float:
    """Return the ratio of a point at the middle of a pixel to its brightest neighbour, dB."""
    return min(_fall_db(grid, axis) for axis in (0, 1))


def _fall_db(grid: ImageGrid, axis: int) -> float:
    """Return the fall of the response from its peak to the next pixel in azimuth (0) or range (1), dB."""
    offset = np.array([0.0, grid.spacing_m[axis] / grid.resolution_m[axis]])
    peak, beside = grid.response.density(offset)
    fall = float(to_db(peak, max(float(beside), 1e-30 * float(peak))))
    if not isinstance(grid.response, Gaussian):
        return fall
    unweighted = float(np.sinc(min(_SINC_WIDTH * offset[1], 1.0)))
    return max(fall, -20 * math.log10(max(unweighted, math.sqrt(CHANCE) / 2)))  # off the middle along both axes


def _lines(dataset: Dataset, bright: float) -> list[str]:
    """Describe rows or columns brighter as a whole than both of their neighbours beyond the response."""
    texts = []
    typical = np.array([_typical_power(image) for image in dataset.power])[:, None]
    for name, axis, grid_axis in (("row", 2, 1), ("column", 1, 0)):
        medians = np.median(dataset.power, axis=axis)  # [v, lines]
        if medians.shape[1] < _MIN_LINES:
            continue
        padded = np.pad(medians, ((0, 0), (1, 1)))
        beside = np.maximum(np.maximum(padded[:, :-2], padded[:, 2:]), typical)
        lead = np.where(medians >= (typical if dataset.ground else bright), to_db(medians, beside), -np.inf)
        limit = _fall_db(dataset.grid, grid_axis) + _LINE_DB
        if lead.max() > limit:
            index, line = np.unravel_index(int(lead.argmax()), lead.shape)
            images = counted(int((lead > limit).any(axis=1).sum()), "image")
            texts.append(
                f"{name} {line} of {dataset.entries[index].name} is as a whole {lead[index, line]:.0f} dB brighter "
                f"than the {name}s beside it, as no echo of the stated resolution is (such {name}s are in {images}); "
                "mend the files, or cut the images"
            )
    return texts
