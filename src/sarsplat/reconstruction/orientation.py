"""Whether images are the way up that their metadata say: which rows are near, and which way azimuths run.

The shadow of what stands on the ground lies beyond it. And images of neighbouring azimuths, projected on the ground,
show the same target if azimuths run the way they are said to; if not, they show it turned by twice the difference. They
match best where they are projected on a plane at the height of what is bright. Of images that show no ground, this
tells near from far, too: what is high is displaced towards the radar.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates

from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.reconstruction.outlines import Outline
from sarsplat.reconstruction.target_box import seen_by_all

_DARKEST_DB = -10.0
"""Below the ground: what is darker says no more."""

_BETWEEN_DEG = (2.0, 60.0)
_PREFERRED_DEG = 15.0
"""Azimuths of images that are compared: so close that they show the same, so far apart that the sense matters."""

_SAME_GRAZING_DEG = 5.0
_PLACES = 64
_PLANES = 9
"""Places along a side of the ground, and heights, at which images are compared."""

_MOST_PAIRS = 60
_FEWEST = 5
"""Pairs, or images: of fewer nothing is said."""


@dataclass(frozen=True)
class Evidence:
    """What many images, or pairs of images, say: positive for the metadata, negative against them.

    Attributes
    ----------
    mean : float
        Mean over all.
    significance : float
        The mean in units of its standard deviation, as estimated from the spread.
    count : int
        Number of images or pairs; 0 if there are too few.
    """

    mean: float
    significance: float
    count: int

    def against(self, least: float) -> bool:
        """Whether they contradict, by at least so much."""
        return self.mean < -least and self.significance < -_SURE

    def supports(self, least: float) -> bool:
        """Whether they agree, by at least so much."""
        return self.mean > least and self.significance > _SURE


_SURE = 5.0

NOTHING = Evidence(0.0, 0.0, 0)


@dataclass(frozen=True)
class Match:
    """How well images of neighbouring azimuths match.

    Attributes
    ----------
    sense : Evidence
        By how much the correlation is higher with azimuths as given than with azimuths in the opposite sense.
    upright : Evidence
        By how much, in the better sense, it is higher on planes above the ground than as far below.
    """

    sense: Evidence
    upright: Evidence


def shadow_beyond(levels: Float64[np.ndarray, "v rows columns"], outlines: Sequence[Outline]) -> Evidence:
    """By how many decibels it is darker beyond the target than before it, if row 0 is near range.

    Parameters
    ----------
    levels : numpy.ndarray, float64 [V, rows, columns]
        Decibels above the ground, of images that show it.
    outlines : sequence of Outline
        Of the same images.
    """
    found = []
    for level, outline in zip(levels, outlines, strict=True):
        rows = np.flatnonzero(outline.target.any(axis=1))
        if not len(rows):
            continue
        window = max(3, int(rows[-1] - rows[0]) + 1)
        dark = np.clip(level, _DARKEST_DB, 0.0)
        darker = []
        for column in np.flatnonzero(outline.target.any(axis=0)):
            first, last = np.flatnonzero(outline.target[:, column])[[0, -1]]
            before, beyond = dark[max(0, first - window) : first, column], dark[last + 1 : last + 1 + window, column]
            if len(before) and len(beyond):
                darker.append(before.mean() - beyond.mean())
        if darker:
            found.append(float(np.mean(darker)))
    return _evidence(np.array(found))


def neighbours_match(
    levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View], grid: ImageGrid
) -> Match | None:
    """How well images of neighbouring azimuths match; None if there are too few pairs, or they do not show the origin.

    Parameters
    ----------
    levels : numpy.ndarray, float64 [V, rows, columns]
        Decibels above the ground, or above what counts as nothing.
    views, grid
        Where they were taken from, and where their pixels lie.
    """
    pairs, half = _pairs(views), seen_by_all(views, grid)
    if len(pairs) < _FEWEST or half <= 0:
        return None
    axis = np.linspace(-half, half, _PLACES)
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 < half**2
    x, y = x[inside], y[inside]
    heights = np.linspace(-half / 3, half / 3, _PLANES)
    bright = np.maximum(levels, 0.0)  # a shadow ends where something below the ground would be
    used = sorted({k for pair in pairs for k in pair})
    matches = np.full((2, _PLANES, len(pairs)), np.nan)
    for s, sense in enumerate((1, -1)):
        for h, height in enumerate(heights):
            seen = {k: _on_plane(bright[k], _turned(views[k], sense), grid, x, y, height) for k in used}
            matches[s, h] = [_correlation(seen[i], seen[j]) for i, j in pairs]
    matches = matches[:, :, np.isfinite(matches).all(axis=(0, 1))]
    if matches.shape[2] < _FEWEST:
        return None
    mean = matches.mean(axis=2)
    as_given, opposite = (matches[s, mean[s].argmax()] for s in (0, 1))
    better = matches[int(mean.max(axis=1).argmax())]
    above, below = better[_PLANES // 2 + 1 :].mean(axis=0), better[: _PLANES // 2].mean(axis=0)
    return Match(_evidence(as_given - opposite), _evidence(above - below))


def _pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Each view with the one clockwise of it that suits best; evenly chosen of too many."""
    azimuths = np.array([view.azimuth_deg for view in views]) % 360
    grazings = np.array([view.grazing_deg for view in views])
    pairs = []
    for k in range(len(views)):
        apart = (azimuths - azimuths[k]) % 360
        suits = (apart > _BETWEEN_DEG[0]) & (apart <= _BETWEEN_DEG[1])
        suits &= np.abs(grazings - grazings[k]) <= _SAME_GRAZING_DEG
        if suits.any():
            pairs.append((k, int(np.flatnonzero(suits)[np.abs(apart[suits] - _PREFERRED_DEG).argmin()])))
    count = min(len(pairs), _MOST_PAIRS)
    return [pairs[k * len(pairs) // count] for k in range(count)]


def _turned(view: View, sense: int) -> View:
    return View((sense * view.azimuth_deg) % 360, view.grazing_deg)


def _on_plane(
    image: Float64[np.ndarray, "rows columns"],
    view: View,
    grid: ImageGrid,
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    height: float,
) -> Float64[np.ndarray, " n"]:
    """An image at places of a level plane; NaN outside of it."""
    across, _, along = radar_frame(view) @ np.stack([x, y, np.full_like(x, height)])
    row = (along - grid.range_m[0]) / grid.spacing_m[1]
    column = (across - grid.azimuth_m[0]) / grid.spacing_m[0]
    return map_coordinates(image, [row, column], order=1, mode="constant", cval=np.nan)


def _correlation(one: Float64[np.ndarray, " n"], other: Float64[np.ndarray, " n"]) -> float:
    both = np.isfinite(one) & np.isfinite(other)
    if not both.any():
        return math.nan
    one, other = one[both] - one[both].mean(), other[both] - other[both].mean()
    norm = math.sqrt(float((one**2).sum() * (other**2).sum()))
    return float((one * other).sum()) / norm if norm > 0 else math.nan


def _evidence(values: Float64[np.ndarray, " n"]) -> Evidence:
    if len(values) < _FEWEST:
        return NOTHING
    deviation = float(values.std(ddof=1)) / math.sqrt(len(values))
    mean = float(values.mean())
    return Evidence(mean, mean / max(deviation, 1e-9), len(values))
