"""Side lobes of the response: what a bright scatterer leaves along its row and its column."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.signal.windows import taylor
from torch import Tensor

from sarsplat.geometry import ImageGrid

_LEVEL_DB, _NEAR = 35, 4
"""Taylor weighting, the commonest of all: side lobes below the main lobe, and how many of them are equally high."""

_SAMPLES, _FINE = 512, 16
"""Of the aperture, and of the response in each of its 1/_SAMPLES of bandwidth."""


def with_side_lobes(
    images: Float[Tensor, "v rows columns"], level: Float[Tensor, " 2"], grid: ImageGrid
) -> Float[Tensor, "v rows columns"]:
    """Power images and the side lobes of all that is in them.

    Parameters
    ----------
    images : Tensor [V, rows, columns]
        Power, seen through a Gaussian response.
    level : Tensor [2]
        Power of the side lobes in azimuth and in range, relative to those of a −35 dB Taylor window; differentiable.
    grid : ImageGrid
        Of the images.
    """
    along_azimuth, along_range = (matrix.to(images) for matrix in _matrices(grid))
    azimuth, slant_range = level[:, None].expand(2, grid.columns)  # so that gradients are summed column by column
    return images + azimuth * (images @ along_azimuth) + slant_range * (along_range @ images)


@lru_cache(maxsize=16)
def _matrices(grid: ImageGrid) -> tuple[Tensor, Tensor]:
    """What a pixel gives to the others of its row, and of its column; symmetric."""
    sizes = zip((grid.columns, grid.rows), grid.spacing_m, grid.resolution_m, strict=True)
    return tuple(_matrix(*size) for size in sizes)  # type: ignore[return-value]


def _matrix(count: int, spacing_m: float, width_m: float) -> Float[Tensor, "{count} {count}"]:
    distance, power = _response()
    reach = np.arange(count) * spacing_m / width_m
    peak = 2 * math.sqrt(math.log(2) / math.pi) * spacing_m / width_m  # of the Gaussian whose sum over all pixels is 1
    row = peak * np.interp(reach, distance, power, right=0.0)
    return torch.from_numpy(row[np.abs(np.subtract.outer(np.arange(count), np.arange(count)))]).float()


@lru_cache(maxsize=1)
def _response() -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distances in widths of the main lobe at half its power, and the power there; the main lobe itself is left out."""
    window = taylor(_SAMPLES, nbar=_NEAR, sll=_LEVEL_DB, norm=False)
    amplitude = np.abs(np.fft.rfft(window, _SAMPLES * _FINE)) / window.sum()
    power = amplitude**2
    first_null = int(np.argmax(np.diff(power) > 0))
    half = np.interp(-0.5, -power[:first_null], np.arange(first_null))
    return np.arange(len(power)) / (2 * half), np.where(np.arange(len(power)) < first_null, 0.0, power)
