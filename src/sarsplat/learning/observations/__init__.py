"""What trainings learn from: each observation is one file of this folder, and `observation_of` finds it there."""

from __future__ import annotations

from sarsplat.learning.observations.observation import Batch, Observation
from sarsplat.plugins import classes_in
from sarsplat.settings.config import Config

__all__ = ["Batch", "Observation", "observations_of"]


def observations_of(config: Config) -> list[type[Observation]]:
    """What a configuration learns from: the first, and what its training goes on with."""
    kinds = classes_in(__name__, Observation)  # type: ignore[type-abstract]
    return [kind for kind in kinds if kind.wanted(config)]
