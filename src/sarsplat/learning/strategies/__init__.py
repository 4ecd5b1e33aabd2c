"""Strategies: changes of a model between steps of Adam, such as density control; each is one file of this folder."""

from sarsplat.data import Dataset
from sarsplat.learning.strategies.strategy import Configured, Info, State, Strategy
from sarsplat.plugins import classes_in
from sarsplat.settings.config import Config

__all__ = ["Info", "State", "Strategy", "strategies_of"]


def strategies_of(config: Config, train: Dataset) -> list[Strategy]:
    """Strategies of a configuration, in the order in which they act."""
    kinds = classes_in(__name__, Configured)
    return [kind(config, train) for kind in kinds if kind.wanted(config, train)]
