"""Phase history made up for tests: points on a flight around them, in GOTCHA's layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from sarsplat.geometry import ImageGrid

C = 299_792_458.0
FREQUENCIES = np.linspace(34.5e9, 35.5e9, 64)


def circle(counterclockwise_deg: np.ndarray, grazing_deg: float = 30.0, radius: float = 3000.0) -> np.ndarray:
    """Antenna places [pulses, 3]."""
    th, phi = np.radians(counterclockwise_deg), np.radians(grazing_deg)
    return radius * np.stack([np.cos(phi) * np.cos(th), np.cos(phi) * np.sin(th), np.sin(phi) + 0 * th], axis=1)


def record(
    antenna: np.ndarray, points: Sequence[tuple[float, float, float]], frequencies: np.ndarray = FREQUENCIES
) -> dict[str, Any]:
    """The record `data` of one file: points of amplitude 1."""
    r0 = np.linalg.norm(antenna, axis=1)
    samples = np.zeros((len(frequencies), len(antenna)), complex)
    for point in points:
        beyond = np.linalg.norm(antenna - np.array(point), axis=1) - r0
        samples += np.exp(-4j * np.pi / C * np.outer(frequencies, beyond))
    x, y, z = antenna.T
    return {"fp": samples.astype(np.complex64), "freq": frequencies[:, None], "x": x, "y": y, "z": z, "r0": r0}


def write(path: Path, data: dict[str, Any]) -> Path:
    """The file of a record."""
    scipy.io.savemat(path, {"data": data})
    return path


def peak(image: np.ndarray, grid: ImageGrid) -> tuple[float, float]:
    """(azimuth, range) of the brightest point, between pixels by a parabola through the logarithms."""
    level = np.log(np.abs(image) + 1e-12)
    row, column = np.unravel_index(level.argmax(), level.shape)

    def between(three):
        return (three[0] - three[2]) / (2 * (three[0] - 2 * three[1] + three[2]))

    return (
        grid.azimuth_m[column] + grid.spacing_m[0] * between(level[row, column - 1 : column + 2]),
        grid.range_m[row] + grid.spacing_m[1] * between(level[row - 1 : row + 2, column]),
    )


def peak_beside(image: np.ndarray, grid: ImageGrid, azimuth_m: float, range_m: float) -> tuple[np.ndarray, float]:
    """How far (azimuth, range), m, the peak is from a place at most two pixels away, by the spectrum, and its level."""
    place = (range_m - grid.range_m[0]) / grid.spacing_m[1], (azimuth_m - grid.azimuth_m[0]) / grid.spacing_m[0]
    within = np.arange(-128, 129) / 64  # pixels
    down, across = (
        np.exp(2j * np.pi * np.outer(at + within, np.fft.fftfreq(size))) / size
        for at, size in zip(place, image.shape, strict=True)
    )
    fine = np.abs(down @ np.fft.fft2(image) @ across.T)
    row, column = np.unravel_index(fine.argmax(), fine.shape)
    return within[[column, row]] * grid.spacing_m, float(fine.max())
