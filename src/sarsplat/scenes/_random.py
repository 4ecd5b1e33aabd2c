"""Random numbers of a seed, of which each purpose has its own."""

from __future__ import annotations

from typing import Literal

import numpy as np

from sarsplat.errors import SarsplatError

_STREAMS: dict[str, tuple[int, ...]] = {"speckle": (), "reflectivity": (1,), "views": (2,)}


def generator(seed: int, purpose: Literal["speckle", "reflectivity", "views"]) -> np.random.Generator:
    """A source of random numbers.

    Raises
    ------
    SarsplatError
        If the seed is negative.
    """
    if seed < 0:
        raise SarsplatError(f"seed {seed} must be at least 0")
    return np.random.default_rng([seed, *_STREAMS[purpose]])
