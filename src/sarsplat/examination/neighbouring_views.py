"""Correlation of images from neighbouring azimuths after rotating one onto the other in the ground plane.

Between two azimuths a target turns by their difference, and with it its image, in one sense and not in the other. What
is high is displaced towards the radar in every image. Lengths in range, divided by the cosine of the grazing angle, are
those on the ground; between two grazing angles they only match with the right ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Real
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import map_coordinates, uniform_filter

from sarsplat.geometry import ImageGrid, View

_BETWEEN_DEG = (2.0, 60.0)
_PREFERRED_DEG = 15.0
"""Azimuths of images that are compared: so close that they show the same, so far apart that the sense matters."""

_SAME_GRAZING_DEG = 5.0
_OTHER_GRAZING_DEG = (5.0, 40.0)
"""Between grazing angles of images that show the same heights, and of those whose lengths in range differ."""

_MOST_PAIRS = 60
_PLACES = 96
"""Along a side of the ground."""

_FREE = 0.5
"""Shift with which images may match, of half the side of the ground: they are centred to a pixel or two, and what is
high is displaced."""

_RADII = np.arange(1, 6) / 5 / 3
"""Displacements towards the radar that are tried, of half the side of the ground."""


_ANYWAY = 0.4
"""Share of the correlation by which images turned by an angle match better if less stretched, of 1 − cos of that angle
and for each e-fold of lengths in range: what is high is displaced, and not as lengths on the ground are. Of honest sets
of buildings, vehicles and SLICY at 48° to 60°, 10° to 30° apart, it is at most 0.3 where that is more than 0.01; of
such at 30° that are said to be at 60°, 0.97 to 3.1."""


@dataclass(frozen=True)
class Matches:
    """Correlation of pairs of images as a function of the shift, after rotating one onto the other on the ground."""

    correlations: Float64[np.ndarray, "n places places"]
    """Of one pair each; shifts are wrapped around, as `numpy.fft.fftfreq` has them."""
    turns: Float64[np.ndarray, "n 2 2"]
    """What brings (azimuth, ground range) of the first image to that of the second."""
    half_m: float
    """Half the side of the ground that was compared."""
    pitch_m: float
    """Distance of its places."""

    def best(self) -> Float64[np.ndarray, " n"]:
        """Each pair's highest correlation, the shift being free."""
        shift = np.fft.fftfreq(self.correlations.shape[1], 1 / self.correlations.shape[1]) * self.pitch_m
        near = np.hypot(shift[:, None], shift) <= _FREE * self.half_m
        return self.correlations[:, near].max(axis=1, initial=-1.0)

    def displaced(self, sense: int) -> Float64[np.ndarray, " n"]:
        """Each pair's mean correlation if what is bright is displaced to row 0 (−1) or away from it (+1)."""
        off = np.stack([np.zeros(len(_RADII)), sense * _RADII * self.half_m], axis=1)
        size = self.correlations.shape[1]
        means = []
        for correlation, turn in zip(self.correlations, self.turns, strict=True):
            shift = (off @ turn - off) / self.pitch_m  # turn.T is the inverse
            at = [shift[:, 1] % size, shift[:, 0] % size]
            means.append(map_coordinates(correlation, at, order=1, mode="grid-wrap").mean())
        return np.array(means)


def match(
    bright: Float64[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    pairs: Sequence[tuple[int, int]],
    *,
    sense: int = 1,
    within: float = 1.0,
) -> Matches:
    """Correlate pairs of images on the ground.

    `bright` is decibels above the ground, or above what counts as nothing, not negative: shadows do not turn with the
    target. `sense` is 1 if azimuths run as given, −1 if they run the other way, 0 if nothing turns; `within` is the
    radius of the ground that is compared, of the largest that every image shows.
    """
    half = reach(grid)
    axis = np.linspace(-half, half, _PLACES)
    across, along = np.meshgrid(axis, axis)
    inside = np.hypot(across, along) < within * half
    pitch = axis[1] - axis[0]
    coarse = [max(1, round(pitch / spacing)) for spacing in reversed(grid.spacing_m)]  # no pixel is left out
    used = sorted({k for pair in pairs for k in pair})
    ground = {
        k: _shown_at(uniform_filter(bright[k], coarse), grid, *views[k].look.to_image(across, along)) for k in used
    }
    padded = (next_fast_len(2 * _PLACES),) * 2
    first = {k: rfft2(_normalised(ground[k], inside), padded).conj() for k, _ in pairs}
    correlations, turns = [], []
    for i, j in pairs:
        angle = math.radians(sense * (views[i].azimuth_deg - views[j].azimuth_deg))
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        x, y = np.tensordot(turn, np.stack([across, along]), 1)
        other = _at(ground[j], (x + half) / pitch, (y + half) / pitch)
        correlations.append(irfft2(first[i] * rfft2(_normalised(other, inside), padded), padded))
        turns.append(turn)
    return Matches(np.array(correlations).reshape(-1, *padded), np.array(turns).reshape(-1, 2, 2), half, float(pitch))


def as_grazing_and_incidence(
    bright: Float64[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    pairs: Sequence[tuple[int, int]],
    sense: int,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Each pair's highest correlation with grazing angles as given, and with 90° less them.

    As many pixels are compared either way: the more ground is around a target, the lower is the correlation.
    """
    meant = views, [replace(view, grazing_deg=view.incidence_deg) for view in views]
    scales = [float(np.mean([view.look.slant_range(1.0) for view in views])) for views in meant]
    given, swapped = (
        match(bright, views, grid, pairs, sense=sense, within=math.sqrt(min(scales) / scale)).best()
        for views, scale in zip(meant, scales, strict=True)
    )
    return given, swapped


def less_stretched_anyway(
    views: Sequence[View], pairs: Sequence[tuple[int, int]], correlations: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """By how much pairs that match so well may match better with 90° less their grazing angles, though these are right.

    Nothing where lengths in range become no shorter by that.
    """
    steep = [math.log(look.sine / float(look.slant_range(1.0))) for look in (view.look for view in views)]
    shorter = np.array([max((steep[i] + steep[j]) / 2, 0.0) for i, j in pairs])
    turned = np.array([1 - float(views[i].look.ahead @ views[j].look.ahead) for i, j in pairs])
    return _ANYWAY * shorter * turned * np.maximum(correlations, 0.0)


def reach(grid: ImageGrid) -> float:
    """Half the side of the ground around the origin that every image shows, whichever side of it is near, m."""
    return min(
        pixels * spacing / 2 - abs(middle)
        for pixels in (grid.rows, grid.columns)
        for spacing, middle in zip(grid.spacing_m, grid.center_m, strict=True)
    )


def neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Each view with the one clockwise of it that suits best; evenly chosen of too many."""
    azimuths, grazings = _angles(views)
    pairs = []
    for k in range(len(views)):
        apart = (azimuths - azimuths[k]) % 360
        suits = (apart > _BETWEEN_DEG[0]) & (apart <= _BETWEEN_DEG[1])
        suits &= np.abs(grazings - grazings[k]) <= _SAME_GRAZING_DEG
        if suits.any():
            pairs.append((k, int(np.where(suits, np.abs(apart - _PREFERRED_DEG), np.inf).argmin())))
    return _evenly(pairs)


def steeper_neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Each view with the nearest one of about the same azimuth that is steeper; evenly chosen of too many."""
    azimuths, grazings = _angles(views)
    pairs = []
    for k in range(len(views)):
        apart = np.abs((azimuths - azimuths[k] + 180) % 360 - 180)
        steeper = grazings - grazings[k]
        suits = (apart <= _PREFERRED_DEG) & (steeper > _OTHER_GRAZING_DEG[0]) & (steeper <= _OTHER_GRAZING_DEG[1])
        if suits.any():
            pairs.append((k, int(np.where(suits, apart + steeper, np.inf).argmin())))
    return _evenly(pairs)


def _angles(views: Sequence[View]) -> tuple[Float64[np.ndarray, " v"], Float64[np.ndarray, " v"]]:
    return np.array([view.azimuth_deg for view in views]) % 360, np.array([view.grazing_deg for view in views])


def _evenly(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    count = min(len(pairs), _MOST_PAIRS)
    return [pairs[k * len(pairs) // count] for k in range(count)]


def _at(
    image: Real[np.ndarray, "rows columns"],
    column: Float64[np.ndarray, "places places"],
    row: Float64[np.ndarray, "places places"],
) -> Real[np.ndarray, "places places"]:
    return map_coordinates(image, [row, column], order=1, mode="constant", cval=0.0)


def _shown_at(
    image: Real[np.ndarray, "rows columns"],
    grid: ImageGrid,
    azimuth_m: Float64[np.ndarray, "places places"],
    range_m: Float64[np.ndarray, "places places"],
) -> Real[np.ndarray, "places places"]:
    """What an image shows at these azimuths and slant ranges; nothing beyond its edges."""
    column = (azimuth_m - grid.azimuth_m[0]) / grid.spacing_m[0]
    return _at(image, column, (range_m - grid.range_m[0]) / grid.spacing_m[1])


def _normalised(image: Real[np.ndarray, "places places"], inside: np.ndarray) -> Real[np.ndarray, "places places"]:
    """Normalise to mean 0 and norm 1 inside the mask, 0 outside; 0 everywhere if nothing varies."""
    rest = np.where(inside, image - image[inside].mean(), 0.0)
    norm = math.sqrt(float((rest**2).sum()))
    return rest / norm if norm > 0 else rest
