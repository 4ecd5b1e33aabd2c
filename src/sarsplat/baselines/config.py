"""Settings that every method shares; needs no torch."""

from __future__ import annotations

from dataclasses import dataclass

from sarsplat.reconstruction.config import AnyConfig, Count, Seed


@dataclass(frozen=True)
class BaselineConfig(AnyConfig):
    """Base of a method's settings.

    Parameters
    ----------
    iterations : int
        Length of a whole training.
    checkpoint_every : int
        Iterations between two checkpoints.
    views_per_step : int
        Training images in one step.
    seed : int
        Of everything random.

    Raises
    ------
    SarsplatError
        If a value is of another type or out of range.
    """

    iterations: Count = 1000
    checkpoint_every: Count = 100
    views_per_step: Count = 1
    seed: Seed = 0
