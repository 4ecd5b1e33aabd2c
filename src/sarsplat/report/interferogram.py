"""Interferograms of two passes: deramped phase and coherence of each pixel."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Float64
from scipy.ndimage import correlate

from sarsplat.geometry import Stack, View

_STRAYS = 0.01, 0.99
"""Heights of points beyond these quantiles do not count."""


@dataclass(frozen=True)
class Pair:
    """Numbers of two passes: of what is higher, the interferogram of `first` with `second` has more phase."""

    first: int
    second: int
    cycle_m: float
    """Height that is one turn of the phase, m."""

    @classmethod
    def longest(cls, stack: Stack, view: View, height_m: float) -> Pair:
        """The pair that tells heights best among those whose phase turns at most once over `height_m`.

        If there is none, the pair whose phase turns least.
        """
        per_height = stack.elevation_numbers(view) / view.look.height_per_elevation
        pairs = [
            cls(
                i, j, float(f"{2 * math.pi / (per_height[i] - per_height[j]):.6g}")
            )  # of even passes, the first are alike
            for i, j in itertools.permutations(range(len(stack)), 2)
            if per_height[i] > per_height[j]
        ]
        unambiguous = [pair for pair in pairs if pair.cycle_m >= height_m]
        if unambiguous:
            return min(unambiguous, key=lambda pair: pair.cycle_m)
        return max(pairs, key=lambda pair: pair.cycle_m)

    def of_signals(
        self, signals: Complex[np.ndarray, "p rows columns"], level: Float[np.ndarray, "p rows columns"]
    ) -> Float64[np.ndarray, "4 rows columns"]:
        """The interferogram of the pair, from the signals of all passes and the phases of level ground, rad."""
        first, second = signals[self.first], signals[self.second]
        return self._parts(abs(first) ** 2, abs(second) ** 2, first * second.conj(), level)

    def of_covariances(
        self, covariances: Complex[np.ndarray, "p p rows columns"], level: Float[np.ndarray, "p rows columns"]
    ) -> Float64[np.ndarray, "4 rows columns"]:
        """The interferogram of the pair, from covariances."""
        i, j = self.first, self.second
        return self._parts(covariances[i, i].real, covariances[j, j].real, covariances[i, j], level)

    def _parts(self, power: np.ndarray, other: np.ndarray, product: np.ndarray, level: np.ndarray) -> np.ndarray:
        deramped = product * np.exp(1j * (level[self.second] - level[self.first]))
        return np.stack([power, other, deramped.real, deramped.imag]).astype(np.float64)


@dataclass(frozen=True)
class Interferogram:
    """Phase, rad, and coherence, 0 to 1, of each pixel."""

    phase: Float64[np.ndarray, "rows columns"]
    coherence: Float64[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, parts: Float64[np.ndarray, "4 rows columns"]) -> Interferogram:
        """The interferogram from both powers and the deramped product of the two passes."""
        first, second, real, imaginary = parts
        least = np.finfo(np.float64).tiny
        coherence = np.hypot(real, imaginary) / np.sqrt(np.maximum(first * second, least))
        return cls(np.arctan2(imaginary, real), np.clip(coherence, 0, 1))


def averaged(parts: Float64[np.ndarray, "n rows columns"], window: int) -> Float64[np.ndarray, "n rows columns"]:
    """Means over `window` × `window` pixels; at edges over what there is of the window, as in training."""
    weights = np.ones((1, window, window))
    count = correlate(np.ones_like(parts[:1]), weights, mode="constant")
    means: Float64[np.ndarray, "n rows columns"] = correlate(parts, weights, mode="constant") / count
    return means


def spread_m(points: Float[np.ndarray, "p 3"]) -> float:
    """Height range of points, m, without outliers."""
    return float(np.ptp(np.quantile(points[:, 2], _STRAYS))) if len(points) else 0.0
