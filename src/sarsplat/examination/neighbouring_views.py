"""Correlation of images from neighbouring azimuths after rotating one onto the other in the ground plane.

Between two azimuths the target, and so its image, turns by their difference. High parts are displaced towards the radar
in every image. Slant lengths divided by cos(grazing) are ground lengths: between two grazing angles they match only if
the angles are right.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Real
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import map_coordinates, uniform_filter

from sarsplat.geometry import ImageGrid, View

_AZIMUTH_STEP_DEG = (2.0, 60.0)
_PREFERRED_STEP_DEG = 15.0
"""Azimuth differences of compared images: small enough to show the same parts, large enough to show the sense."""

_SAME_GRAZING_DEG = 5.0
_OTHER_GRAZING_DEG = (5.0, 40.0)
"""Differences of grazing angles at which layover is about the same, and at which lengths in range differ."""

_MAX_PAIRS = 60
_SAMPLES = 96  # samples along each side of the ground

_MAX_SHIFT = 0.5
"""Maximum shift between matching images, relative to half the side of the ground: centring errors and layover."""

_LAYOVERS = np.arange(1, 6) / 5 / 3
"""Displacements towards the radar that are tried, relative to half the side of the ground."""

_STRETCH_BIAS = 0.4
"""Relative gain in correlation from less stretched ranges, per 1 − cos(turn) and e-fold of length, with right angles:
layover does not scale as ground lengths do. Measured: at most 0.3 for buildings, vehicles and SLICY at 48° to 60°, 10°
to 30° apart, where the gain exceeds 0.01; 0.97 to 3.1 for images at 30° labelled 60°."""


@dataclass(frozen=True)
class Matches:
    """Correlation of pairs of images as a function of the shift, after rotating one onto the other on the ground."""

    correlations: Float64[np.ndarray, "n samples samples"]
    """Correlation of each pair by shift, in the order of `numpy.fft.fftfreq`."""
    turns: Float64[np.ndarray, "n 2 2"]
    """Rotation of (azimuth, ground range) from the first image of a pair to the second."""
    half_m: float
    """Half the side of the compared ground, m."""
    pitch_m: float
    """Sample spacing, m."""

    def best(self) -> Float64[np.ndarray, " n"]:
        """Return each pair's highest correlation over all allowed shifts."""
        shift = np.fft.fftfreq(self.correlations.shape[1], 1 / self.correlations.shape[1]) * self.pitch_m
        near = np.hypot(shift[:, None], shift) <= _MAX_SHIFT * self.half_m
        return self.correlations[:, near].max(axis=1, initial=-1.0)

    def displaced(self, sense: int) -> Float64[np.ndarray, " n"]:
        """Return each pair's mean correlation with bright pixels displaced towards row 0 (−1) or away from it (+1)."""
        layover = np.stack([np.zeros(len(_LAYOVERS)), sense * _LAYOVERS * self.half_m], axis=1)
        size = self.correlations.shape[1]
        means = []
        for correlation, turn in zip(self.correlations, self.turns, strict=True):
            shift = (layover @ turn - layover) / self.pitch_m  # turn.T is the inverse
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

    `bright` is dB above the ground or noise floor, clipped at 0, since shadows do not turn with the target. `sense` is
    1 for azimuths as given, −1 for the opposite sense, 0 for no rotation; `within` is the compared radius relative to
    the largest that every image shows.
    """
    half = common_half_side_m(grid)
    axis = np.linspace(-half, half, _SAMPLES)
    across, along = np.meshgrid(axis, axis)
    inside = np.hypot(across, along) < within * half
    pitch = axis[1] - axis[0]
    coarse = [max(1, round(pitch / spacing)) for spacing in reversed(grid.spacing_m)]  # every pixel counts
    used = sorted({k for pair in pairs for k in pair})
    ground = {}
    for k in used:
        azimuth_m, range_m = views[k].look.to_image(across, along)
        place = (range_m - grid.range_m[0]) / grid.spacing_m[1], (azimuth_m - grid.azimuth_m[0]) / grid.spacing_m[0]
        ground[k] = map_coordinates(uniform_filter(bright[k], coarse), place, order=1)  # 0 beyond the edges
    padded = (next_fast_len(2 * _SAMPLES),) * 2
    first = {k: rfft2(_normalised(ground[k], inside), padded).conj() for k, _ in pairs}
    correlations, turns = [], []
    for i, j in pairs:
        angle = math.radians(sense * (views[i].azimuth_deg - views[j].azimuth_deg))
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        x, y = np.tensordot(turn, np.stack([across, along]), 1)
        other = map_coordinates(ground[j], [(y + half) / pitch, (x + half) / pitch], order=1)
        correlations.append(irfft2(first[i] * rfft2(_normalised(other, inside), padded), padded))
        turns.append(turn)
    return Matches(np.array(correlations).reshape(-1, *padded), np.array(turns).reshape(-1, 2, 2), half, float(pitch))


def stretch_bias(
    views: Sequence[View], pairs: Sequence[tuple[int, int]], correlations: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return each pair's expected gain in correlation from taking right grazing angles for incidence angles.

    The gain is 0 where that does not shorten lengths in range.
    """
    stretch = [math.log(look.sine / float(look.slant_range(1.0))) for look in (view.look for view in views)]
    shortening = np.array([max((stretch[i] + stretch[j]) / 2, 0.0) for i, j in pairs])
    turned = np.array([1 - float(views[i].look.ahead @ views[j].look.ahead) for i, j in pairs])
    return _STRETCH_BIAS * shortening * turned * np.maximum(correlations, 0.0)


def common_half_side_m(grid: ImageGrid) -> float:
    """Return half the side of the ground around the origin that every image shows for any near side, m."""
    return min(
        pixels * spacing / 2 - abs(middle)
        for pixels in (grid.rows, grid.columns)
        for spacing, middle in zip(grid.spacing_m, grid.center_m, strict=True)
    )


def neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Pair each view with its most suitable clockwise neighbour; at most `_MAX_PAIRS`, evenly chosen."""
    azimuths_deg, steeper_deg = _differences_deg(views)
    clockwise_deg = azimuths_deg % 360
    suitable = (clockwise_deg > _AZIMUTH_STEP_DEG[0]) & (clockwise_deg <= _AZIMUTH_STEP_DEG[1])
    suitable &= np.abs(steeper_deg) <= _SAME_GRAZING_DEG
    return _pairs(suitable, np.abs(clockwise_deg - _PREFERRED_STEP_DEG))


def steeper_neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Pair each view with the nearest steeper view of about the same azimuth; at most `_MAX_PAIRS`, evenly chosen."""
    azimuths_deg, steeper_deg = _differences_deg(views)
    step_deg = np.abs((azimuths_deg + 180) % 360 - 180)
    suitable = (step_deg <= _PREFERRED_STEP_DEG) & (steeper_deg > _OTHER_GRAZING_DEG[0])
    return _pairs(suitable & (steeper_deg <= _OTHER_GRAZING_DEG[1]), step_deg + steeper_deg)


def _differences_deg(views: Sequence[View]) -> Float64[np.ndarray, "2 v v"]:
    """Return by how much the azimuth of each view (column) exceeds that of every view (row), and its grazing angle."""
    azimuths, grazings = np.array([(view.azimuth_deg % 360, view.grazing_deg) for view in views]).T
    return np.stack([azimuths - azimuths[:, None], grazings - grazings[:, None]])


def _pairs(suitable: Bool[np.ndarray, "v v"], cost: Float64[np.ndarray, "v v"]) -> list[tuple[int, int]]:
    """Pair each view (row) with its cheapest suitable one, if any; at most `_MAX_PAIRS`, evenly chosen."""
    cheapest = np.where(suitable, cost, np.inf).argmin(axis=1).tolist()
    pairs = [(k, other) for k, other in enumerate(cheapest) if suitable[k, other]]
    count = min(len(pairs), _MAX_PAIRS)
    return [pairs[k * len(pairs) // count] for k in range(count)]


def _normalised(image: Real[np.ndarray, "samples samples"], inside: np.ndarray) -> Real[np.ndarray, "samples samples"]:
    """Normalise to mean 0 and norm 1 inside the mask; 0 outside, and everywhere if the image is constant."""
    centred = np.where(inside, image - image[inside].mean(), 0.0)
    norm = math.sqrt(float((centred**2).sum()))
    return centred / norm if norm > 0 else centred
