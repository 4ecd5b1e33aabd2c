"""Single values that would set the scale of everything: pixels and lines that stand alone, and impossible ranges.

A true point target, however bright, is spread over neighbouring pixels by the response of the system, so that the
brightest of its neighbours cannot be darker than the response is one pixel away from its peak. Speckle may add to that:
in N pixels of one look, drawn independently of each other, some pixel exceeds all of its eight neighbours t times with
a probability below 8! N / t⁸. A Gaussian response stands for any of its width, also for that without weighting, whose
zeros lie on the neighbours where pixels are as far apart as can be: there, a point exceeds them by what it is off the
middle of its pixel.
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

WIDEST_RANGE_DB = 100.0
"""From the ground to the brightest pixel of an image: more than any radar, and any echo, has."""

A_FEW = 5
"""Brightest pixels of an image without which its range is that of its unit."""

_LINE_DB = 10.0
"""By which medians of neighbouring rows or columns of ground may differ, beside what the response allows."""

_SINC_WIDTH = 0.8859
"""3 dB width of the response without weighting, of the distance from its peak to its first zero."""

_FEWEST_LINES = 3
_FEWEST_IMAGES = 3


def examine_single_values(dataset: Dataset, examined: Examination) -> bool:
    """Add contradictions of pixels and lines that no response can make, and of images with an impossible range.

    Returns whether there are any. Where most images have an impossible range, and not by a few pixels, it is their unit
    that is wrong: see `examine_units`.
    """
    if 2 * (ranges_db(dataset, A_FEW) > WIDEST_RANGE_DB).sum() > len(dataset):
        return False
    bright = bright_level(dataset.power)
    limit_db = _point_db(dataset.grid) + _speckle_db(dataset.power.size)
    alone = [peak for k, image in enumerate(dataset.power) for peak in _alone(image, k, bright, limit_db)]
    wrong = _said_of(alone, dataset)
    wrong += _ranges(dataset, {peak.index for peak in alone})
    wrong += _lines(dataset, bright)
    examined.conclude("single values", wrong, "no pixel, row or column is too bright to be an echo")
    return bool(wrong)


def _said_of(alone: Sequence[_Peak], dataset: Dataset) -> list[str]:
    if not alone:
        return []
    worst = max(alone, key=lambda peak: peak.lead_db)
    images = counted(len({peak.index for peak in alone}), "image")
    return [
        f"{counted(len(alone), 'pixel')} of {images} {'stands' if len(alone) == 1 else 'stand'} alone, such as row "
        f"{worst.row}, column {worst.column} of {dataset.entries[worst.index].name}, {worst.lead_db:.0f} dB above all "
        f"of its neighbours, where a point of the stated resolution is {_point_db(dataset.grid):.0f} dB above them; a "
        "hot pixel sets the scale of all others, so replace it by the mean of its neighbours, or correct the "
        "resolution if it is an echo"
    ]


def _floors(dataset: Dataset) -> Float64[np.ndarray, " v"]:
    """Of each image, the power of its ground; without ground, the second brightest peak of all images for all."""
    if dataset.ground:
        return np.maximum(np.median(dataset.power, axis=(1, 2)).astype(np.float64), np.finfo(np.float32).tiny)
    peaks = np.sort(dataset.power.max(axis=(1, 2)))
    floor = float(peaks[-2]) if len(peaks) >= _FEWEST_IMAGES else float(peaks[-1])
    return np.full(len(dataset), max(floor, np.finfo(np.float32).tiny))


def ranges_db(dataset: Dataset, place: int = 1) -> Float64[np.ndarray, " v"]:
    """From the ground of each image to its brightest pixel, or to that in another place."""
    place = min(place, dataset.power[0].size)
    brightest = [np.partition(image, -place, axis=None)[-place] for image in dataset.power]  # one by one, for memory
    return np.asarray(to_db(np.array(brightest), _floors(dataset)))


def _ranges(dataset: Dataset, explained: Collection[int]) -> list[str]:
    """Single images whose brightest pixel is impossibly bright, but for those whose pixels have been named."""
    ranges = ranges_db(dataset)
    ranges[[*explained]] = 0.0
    wide = np.flatnonzero(ranges > WIDEST_RANGE_DB)
    if not len(wide):
        return []
    worst = int(wide[ranges[wide].argmax()])
    row, column = np.unravel_index(int(dataset.power[worst].argmax()), dataset.power[worst].shape)
    above = "its ground" if dataset.ground else "that of any other image"
    others = f" (so in {counted(len(wide), 'image')})" if len(wide) > 1 else ""
    return [
        f"the brightest pixel of {dataset.entries[worst].name}, row {row}, column {column}, is {ranges[worst]:.0f} dB "
        f"above {above}{others}, more than any radar image has; mend the file: all else sinks beside it"
    ]


@dataclass(frozen=True)
class _Peak:
    """A pixel that is brighter than its neighbours."""

    index: int
    row: int
    column: int
    lead_db: float


def _alone(image: Real[np.ndarray, "rows columns"], index: int, bright: float, limit_db: float) -> list[_Peak]:
    """The bright pixels of an image that exceed all of their neighbours by more than the limit."""
    rows, columns = np.nonzero(image >= bright)
    padded = np.pad(image, 1)
    beside = np.full(len(rows), _usual(image))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            if (down, right) != (0, 0):
                beside = np.maximum(beside, padded[rows + 1 + down, columns + 1 + right])
    leads = to_db(image[rows, columns], beside)
    return [
        _Peak(index, int(row), int(column), float(lead))
        for row, column, lead in zip(rows, columns, leads, strict=True)
        if lead > limit_db
    ]


def _usual(image: Real[np.ndarray, "rows columns"]) -> float:
    """Mean power but for the brightest tenth: where ground is quantised coarsely, single pixels and medians jump."""
    dark = image[image <= np.quantile(image, 0.9)].mean(dtype=np.float64)
    return max(float(dark), float(np.finfo(np.float32).tiny))


def _point_db(grid: ImageGrid) -> float:
    """By how much a point at the middle of a pixel exceeds the brightest of its neighbours, dB."""
    return min(_next_db(grid, axis) for axis in (0, 1))


def _next_db(grid: ImageGrid, axis: int) -> float:
    """Of azimuth (0) or range (1): by how much the response falls from its peak to the next pixel, dB."""
    apart = np.array([0.0, grid.spacing_m[axis] / grid.resolution_m[axis]])
    peak, beside = grid.response.density(apart)
    fall = float(to_db(peak, max(float(beside), 1e-30 * float(peak))))
    if not isinstance(grid.response, Gaussian):
        return fall
    unweighted = float(np.sinc(min(_SINC_WIDTH * apart[1], 1.0)))
    return max(fall, -20 * math.log10(max(unweighted, math.sqrt(CHANCE) / 2)))  # off the middle along both axes


def _speckle_db(pixels: int) -> float:
    """By how much speckle of one look exceeds all eight neighbours, but for a chance, in so many pixels, dB."""
    return 10 / 8 * math.log10(math.factorial(8) * pixels / CHANCE)


def _lines(dataset: Dataset, bright: float) -> list[str]:
    """Rows or columns that are brighter, as a whole, than both of their neighbours, beyond what a response can do."""
    found = []
    usual = np.array([_usual(image) for image in dataset.power])[:, None]
    for name, axis, own in (("row", 2, 1), ("column", 1, 0)):
        medians = np.median(dataset.power, axis=axis)  # [v, lines]
        if medians.shape[1] < _FEWEST_LINES:
            continue
        padded = np.pad(medians, ((0, 0), (1, 1)))
        beside = np.maximum(np.maximum(padded[:, :-2], padded[:, 2:]), usual)
        lead = np.where(medians >= (usual if dataset.ground else bright), to_db(medians, beside), -np.inf)
        limit = _next_db(dataset.grid, own) + _LINE_DB
        if lead.max() > limit:
            index, line = np.unravel_index(int(lead.argmax()), lead.shape)
            images = counted(int((lead > limit).any(axis=1).sum()), "image")
            found.append(
                f"{name} {line} of {dataset.entries[index].name} is as a whole {lead[index, line]:.0f} dB brighter "
                f"than the {name}s beside it, as no echo of the stated resolution is (such {name}s are in {images}); "
                "mend the files, or cut the images"
            )
    return found
