"""Random numbers from a seed: each purpose has its own stream."""

from __future__ import annotations

from typing import Literal

import numpy as np

from sarsplat.errors import SarsplatError

_STREAMS: dict[str, tuple[int, ...]] = {"speckle": (), "reflectivity": (1,), "views": (2,), "scatterers": (3,)}


def generator(seed: int, purpose: Literal["speckle", "reflectivity", "views", "scatterers"]) -> np.random.Generator:
    """Make the random generator for one purpose; raise if the seed is negative."""
    if seed < 0:
        raise SarsplatError(f"seed {seed} must be at least 0")
    return np.random.default_rng([seed, *_STREAMS[purpose]])
