"""Terrain for tests: slopes, walls and hills, and GeoTIFFs of them."""

import math
from pathlib import Path

import numpy as np
import tifffile

from sarsplat import Terrain

PROJECTED = (1, 1, 0, 2, 1024, 0, 1, 1, 3076, 0, 1, 9001)
"""GeoTIFF keys of a projected system in metres."""


def terrain(height, half_m: tuple[float, float] = (15.0, 15.0), pitch_m: tuple[float, float] = (0.5, 0.5)) -> Terrain:
    """Heights height(x, y) of a rectangle around the origin."""
    x, y = (np.arange(-half, half + pitch / 2, pitch) for half, pitch in zip(half_m, pitch_m, strict=True))
    return Terrain(np.broadcast_to(height(x[None, :], y[:, None]), (len(y), len(x))).astype(float), pitch_m)


def slope(degrees: float) -> Terrain:
    """A plane that falls along +x: its slope faces a radar at azimuth 0 if positive, and away from it if negative."""
    return terrain(lambda x, y: -math.tan(math.radians(degrees)) * x + 0 * y, (60.0, 60.0), (5.0, 4.0))


def hill(height_m: float = 2.5, at: tuple[float, float] = (1.0, 0.0), width_m: float = 1.5) -> Terrain:
    """A round hill on a slight slope."""
    return terrain(
        lambda x, y: height_m * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * width_m**2)) + 0.05 * x,
        (15.0, 12.0),
        (0.5, 0.4),
    )


def write_geotiff(path: Path, heights: np.ndarray, keys=PROJECTED, scale=(2.0, 3.0, 0.0), extra=(), **options) -> Path:
    """What other programs write."""
    tags = [(33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 5e6, 0.0), True)]
    tags += [(33550, "d", 3, scale, True)] if scale else []
    tags += [(34735, "H", len(keys), keys, True)] if keys else []
    tifffile.imwrite(path, heights, metadata=None, extratags=[*tags, *extra], **options)
    return path
