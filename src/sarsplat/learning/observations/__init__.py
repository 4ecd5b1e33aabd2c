"""Observations, which compare a model with images or stacks: each is a file of this folder."""

from sarsplat.learning.observations.observation import Batch, Observation
from sarsplat.plugins import classes_in
from sarsplat.settings.config import Config

__all__ = ["Batch", "Observation", "observations_of"]


def observations_of(config: Config) -> list[type[Observation]]:
    """Observations of a configuration: the first, and those that the training continues with."""
    kinds = classes_in(__name__, Observation)  # type: ignore[type-abstract]
    return [kind for kind in kinds if kind.wanted(config)]
