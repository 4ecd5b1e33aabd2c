"""Correlated speckle: complex white noise filtered by the system's response."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Complex64, Float32, Float64
from scipy import fft

from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Response


class ResponseSpeckle:
    """Fully developed single-look speckle on the pixels of a grid, correlated as its response has it.

    Parameters
    ----------
    grid : ImageGrid
        Pixels, resolution and response.
    """

    def __init__(self, grid: ImageGrid) -> None:
        sizes = zip((grid.rows, grid.columns), grid.spacing_m[::-1], grid.resolution_m[::-1], strict=True)
        weights = np.outer(*(_transfer(grid.response, *size) for size in sizes))
        self._weights = (weights / math.sqrt(np.mean(weights**2))).astype(np.float32)  # white noise keeps its power
        power = np.abs(fft.ifft2(self._weights)) ** 2
        self.pixels = float(power.sum() ** 2 / (power**2).sum())
        """How many pixels a pixel sees through the response: of so many equal ones, powers would vary as of those."""

    def draw(self, rng: np.random.Generator) -> Complex64[np.ndarray, "rows columns"]:
        """Complex amplitudes of mean power 1; it goes on across opposite edges."""
        noise = rng.standard_normal((2, *self._weights.shape), np.float32)  # white in frequency as it is in space
        weights = self._weights * np.float32(math.sqrt(noise[0].size / 2))  # of power 1 after `ifft2`
        drawn: Complex64[np.ndarray, "rows columns"] = fft.ifft2((noise[0] + 1j * noise[1]) * weights)
        return drawn

    def seen(self, scattered: Complex64[np.ndarray, "rows columns"]) -> Complex64[np.ndarray, "rows columns"]:
        """Complex amplitudes that are scattered in each pixel, as the radar images them; as `draw` at the edges."""
        imaged: Complex64[np.ndarray, "rows columns"] = fft.ifft2(fft.fft2(scattered) * self._weights)
        return imaged


def white_speckle(shape: tuple[int, int], rng: np.random.Generator) -> Complex64[np.ndarray, "rows columns"]:
    """Single-look speckle of mean power 1 without correlation, as no radar has it: complex amplitudes."""
    noise: Float32[np.ndarray, "rows columns 2"] = rng.standard_normal((*shape, 2), np.float32) * np.float32(0.5**0.5)
    return noise.view(np.complex64)[..., 0]


def _transfer(response: Response, count: int, spacing_m: float, width_m: float) -> Float64[np.ndarray, " n"]:
    """What the response lets through of each frequency of `count` samples; real, for the response is symmetric."""
    distance = np.fft.fftfreq(count, 1 / count) * (spacing_m / width_m)
    return np.fft.fft(response.amplitude(distance)).real
