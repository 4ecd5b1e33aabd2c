"""Windowed-sinc interpolation of complex, band-limited images.

The interpolating kernel passes the band and suppresses its repetitions; the more an image is oversampled, the shorter
it may be.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from jaxtyping import Complex64, Float64

Pixels = TypeVar("Pixels", bound=np.ndarray)

_SUPPRESSION_DB = 100.0  # of the repetitions of the band
_FEWEST, _MOST = 8, 64  # pixels that one interpolated value is made of, along one axis
_BLOCK = 1 << 14  # values interpolated at a time
_USUALLY_OCCUPIED = 1 / 1.2  # share of the sampled band that radars fill at most


def taps(occupied: float) -> int:
    """Number of interpolation taps along one axis (even), if the image fills this share of the sampled band."""
    # Kaiser's formula: the transition is from the edge of the band to that of its repetition
    needed = (_SUPPRESSION_DB - 8) / (2.285 * 2 * math.pi * max(1 - occupied, 1e-3))
    return 2 * math.ceil(min(max(needed, _FEWEST), _MOST) / 2)


def interpolate(
    image: Complex64[np.ndarray, "rows columns"],
    row: Float64[np.ndarray, " n"],
    column: Float64[np.ndarray, " n"],
    occupied: tuple[float, float],
) -> Complex64[np.ndarray, " n"]:
    """Interpolate an image at points, in pixels from the centre of the first one; it is zero outside.

    Its band must be centred at zero and fill the shares `occupied` of the sampled one along rows and columns.
    """
    high, wide = (taps(share) for share in occupied)
    padded = np.pad(image, ((high, high), (wide, wide)))
    made = np.empty(len(row), np.complex64)
    for start in range(0, len(row), _BLOCK):
        block = slice(start, start + _BLOCK)
        first_row, along_rows = _weights(row[block], high, len(image))
        first_column, along_columns = _weights(column[block], wide, image.shape[1])
        corner = (first_row + high) * padded.shape[1] + first_column + wide
        total = np.zeros(len(corner), np.complex64)
        for i in range(high):
            line = np.zeros(len(corner), np.complex64)
            for j in range(wide):
                line += along_columns[j] * padded.ravel()[corner + (i * padded.shape[1] + j)]
            total += along_rows[i] * line
        made[block] = total
    return made


def resample(pixels: Pixels, rows: Float64[np.ndarray, " m"], columns: Float64[np.ndarray, " n"]) -> Pixels:
    """Resample an image to a parallel lattice, in pixels from the centre of the first one; it is zero outside.

    Its band must be centred at zero, and the lattice no coarser than its own. Power has twice the band of the signal,
    so that its result is approximate.
    """
    height, width = pixels.shape
    sampled = _matrix(rows, height) @ pixels.astype(np.result_type(pixels, np.float64)) @ _matrix(columns, width).T
    return sampled.astype(pixels.dtype)


def _matrix(places: Float64[np.ndarray, " m"], size: int) -> Float64[np.ndarray, "m {size}"]:
    """Interpolation weights of `size` pixels at each place."""
    count = taps(_USUALLY_OCCUPIED)
    first, weights = _weights(places, count, size)
    matrix = np.zeros((len(places), size + 4 * count))  # wide enough for what lies beyond the edges
    matrix[np.arange(len(places))[:, None], 2 * count + first[:, None] + np.arange(count)] = weights.T
    return matrix[:, 2 * count : 2 * count + size]


def _weights(place: Float64[np.ndarray, " n"], count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first pixel of the interpolation at each place, and the weights [count, n]."""
    first = np.floor(place).astype(np.int64) - (count // 2 - 1)
    away = place - first - np.arange(count)[:, None]
    beta = 0.1102 * (_SUPPRESSION_DB - 8.7)
    window = np.i0(beta * np.sqrt(np.maximum(1 - (2 * away / count) ** 2, 0))) / np.i0(beta)
    weights = np.sinc(away) * window
    outside = (first < -count) | (first > size)  # far from the image
    return np.clip(first, -count, size), np.where(outside, 0, weights).astype(np.float32)
