"""One step of Adam: by an engine, or in plain torch on any device, without waiting for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.renderer.engines.abi import filled
from sarsplat.renderer.engines.passes import NewPass

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15

_LARGEST_FACTOR = 2.0**99
"""By which one step may change a positive parameter: its bounds are reached, and float32 is not left."""


@dataclass(frozen=True)
class Stepped:
    """A parameter and its moments, changed in place, and rates and range of each of its columns ([1] without any).

    All on one device and of one floating dtype. `logarithmic`: step the logarithm of a positive value.
    """

    value: Float[Tensor, "*shape"]
    mean: Float[Tensor, "*shape"]
    square: Float[Tensor, "*shape"]
    rates: Float[Tensor, " k"]
    low: Float[Tensor, " k"]
    high: Float[Tensor, " k"]
    logarithmic: bool


@torch.no_grad()
def step(tensors: Sequence[Stepped], gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
    """The `count`-th update of every parameter (from 1), and back into its range; `decays` are factors on the rates."""
    rate, spread = 1 / (1 - BETA1**count), 1 / math.sqrt(1 - BETA2**count)
    max_log_factor = math.log(_LARGEST_FACTOR)
    for tensor, gradient, decay in zip(tensors, gradients, decays, strict=True):
        slope = gradient * tensor.value if tensor.logarithmic else gradient
        tensor.mean.lerp_(slope, 1 - BETA1)
        tensor.square.mul_(BETA2).addcmul_(slope, slope, value=1 - BETA2)
        down = tensor.mean / (tensor.square.sqrt() * spread + EPSILON) * (tensor.rates * (decay * rate))
        value = tensor.value
        moved = value * (-down).clamp(-max_log_factor, max_log_factor).exp() if tensor.logarithmic else value - down
        value.copy_(moved.clamp(tensor.low, tensor.high))  # NaN stays NaN: the next rendering says so


class EngineAdam:
    """`step` on parameters whose memory an engine writes in place."""

    def __init__(self, new_pass: NewPass, tensors: Sequence[Stepped]) -> None:
        self._new_pass, self._tensors = new_pass, tensors  # kept alive: the engine has their addresses only
        constants = {"count": len(tensors), "beta1": BETA1, "beta2": BETA2, "epsilon": EPSILON}
        self._call = filled("adam", constants | {"groups": [_group(tensor) for tensor in tensors]})
        self._groups = self._call.groups[: len(tensors)]

    def step(self, gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
        """As the function `step`."""
        for group, decay in zip(self._groups, decays, strict=True):
            group.decay = decay
        (self._call.beta1_power, self._call.beta2_power), self._call.now = powers(count), None
        self._run(gradients)

    def step_told(self, gradients: Sequence[Tensor], now: Float[Tensor, " n"]) -> None:
        """The same with the decays, and then the `powers`, from where the engine is."""
        self._call.now = now.data_ptr()
        self._run(gradients)

    def _run(self, gradients: Sequence[Tensor]) -> None:
        gradients = [gradient.contiguous() for gradient in gradients]  # kept alive until the call is over
        for group, gradient in zip(self._groups, gradients, strict=True):
            group.gradient = gradient.data_ptr()
        self._new_pass().run("adam", self._call)
        self.tell_torch()

    def tell_torch(self) -> None:
        """The engine wrote behind torch's back: whoever kept the old values for a backward pass is notified."""
        torch.autograd.graph.increment_version([tensor.value for tensor in self._tensors])


def powers(count: int) -> tuple[float, float]:
    """What the moments of the `count`-th step have not seen yet, as shares."""
    return BETA1**count, BETA2**count


def _group(tensor: Stepped) -> dict[str, Any]:
    ranges = {"rate": tensor.rates, "low": tensor.low, "high": tensor.high}
    return {
        **{"value": tensor.value, "mean": tensor.mean, "square": tensor.square, "logarithmic": tensor.logarithmic},
        **{"rows": len(tensor.value), "columns": len(tensor.rates)},
        **{name: tuple(numbers.tolist()) for name, numbers in ranges.items()},
    }


class PlainAdam:
    """`step` of parameters in plain torch."""

    def __init__(self, tensors: Sequence[Stepped]) -> None:
        self.step = partial(step, tensors)


def stepper(new_pass: NewPass | None, tensors: Sequence[Stepped]) -> EngineAdam | PlainAdam:
    """What steps these parameters: an engine's passes, if it steps tables of as many columns."""
    columns = max(len(tensor.rates) for tensor in tensors)
    if new_pass is None or not new_pass().has("adam", {"columns": columns}):
        return PlainAdam(tensors)
    return EngineAdam(new_pass, tensors)
