"""Growth: where finer images differ from what coarser ones have taught, Gaussians are split."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies import ops
from sarsplat.learning.strategies.ranking import running_sums
from sarsplat.learning.strategies.strategy import Configured, Info, State
from sarsplat.settings.config import Config

_SHARE = 0.9
"""Of the images' error, held by those that are split: where images are as predicted, as on flat roofs, nothing is."""


class Growing(Configured):
    """Splits Gaussians where images are predicted badly, at the start of each finer level and halfway to the next."""

    order = 15
    name = "growth"

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        return cls() if config.coarsest > 1 else None

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        if info.model.levels.grows(step - 1):
            info.check()
            ops.split(params, optimizers, state, holding(info.errors(), _SHARE), info.generator)


def holding(errors: Float[Tensor, " n"], share: float) -> Bool[Tensor, " n"]:
    """The smallest set of items whose values sum to at least this share of the total."""
    largest, order = errors.double().sort(descending=True, stable=True)
    held = running_sums(largest)
    return torch.zeros_like(order, dtype=torch.bool).index_copy(0, order, held - largest < share * held[-1])
