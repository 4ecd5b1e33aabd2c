"""Phase history made up for tests: points on a flight around them, in GOTCHA's layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

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
