"""Growth: Gaussians are split where images of a finer level differ from the rendering."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies import ops
from sarsplat.learning.strategies.ops import running_sums
from sarsplat.learning.strategies.strategy import Configured, Info, State
from sarsplat.settings.config import Config

_SHARE = 0.9
"""Share of the images' error held by the Gaussians that are split; the others stay."""


class Growing(Configured):
    """Splits the Gaussians with most of the error, at the start of each finer level and halfway to the next.

    Each split happens once, also if the training is extended and passes its levels again.
    """

    order = 15
    name = "growth"

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        return cls() if config.coarsest > 1 else None

    def initial_state(self, params: dict[str, Tensor]) -> State:
        """Number of splits so far."""
        return State(whole={"times": torch.zeros((), dtype=torch.int64, device="cpu")}, added=("times",))

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        before = info.model.levels.growths(step - 1)
        if before < info.model.levels.growths(step) and before >= int(state.whole["times"]):
            state.whole["times"] = state.whole["times"].new_tensor(before + 1)
            info.check()
            ops.split(params, optimizers, state, holding(info.errors(), _SHARE), info.generator)


def holding(errors: Float[Tensor, " n"], share: float) -> Bool[Tensor, " n"]:
    """Mask of the fewest items whose errors sum to at least this share of the total."""
    largest, order = errors.double().sort(descending=True, stable=True)
    held = running_sums(largest)
    return torch.zeros_like(order, dtype=torch.bool).index_copy(0, order, held - largest < share * held[-1])
