"""Relocation: idle Gaussians take over a part of strong ones, so that few are enough."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies import ops
from sarsplat.learning.strategies.ops import running_sums
from sarsplat.learning.strategies.strategy import Configured, Info, State, at_round
from sarsplat.radiometry import usual_peak
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Relocation


class Relocating(Configured):
    """Moves the weakest Gaussians to strong ones, at intervals."""

    order = 20
    name = "relocation"

    def __init__(self, config: Relocation, iterations: int) -> None:
        self._config, self._iterations = config, iterations

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        return cls(config.relocation, config.iterations) if config.relocation.rounds else None

    def due(self, step: int) -> bool:
        return step > 0 and at_round(step, 0, self._config.until * self._iterations, self._config.rounds)

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        if self.due(step):
            info.check()
            idle, strong = pairs(info.cross_sections(), self._config.idle_share, info.generator)
            ops.relocate(params, optimizers, state, idle, strong, info.generator)


def pairs(
    cross_sections: Float[Tensor, " n"], idle_share: float, generator: torch.Generator
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]:
    """Indices of the idle Gaussians, and of the strong one that each joins; no index is in both.

    Idle are the weakest that together have at most `idle_share` of all radar cross-sections σ, m². The probability to
    be joined is proportional to σ, which is capped at `usual_peak`: beside a corner reflector, all else would be idle.
    """
    sigma = cross_sections.double().clamp(max=usual_peak(cross_sections.cpu().numpy()))
    order = sigma.argsort(stable=True)
    held = running_sums(sigma[order])
    idle = order[held <= idle_share * held[-1]][: len(order) // 2]
    weights = sigma.index_fill(0, idle, 0.0)
    idle = idle[: int((weights > 0).sum())]
    if not len(idle):
        return idle, idle
    # as `torch.multinomial` does on the CPU, with the same numbers on every device
    chance = torch.empty(len(sigma), dtype=torch.float64, device="cpu").exponential_(generator=generator)
    return idle, (weights / chance.to(weights.device)).topk(len(idle)).indices
