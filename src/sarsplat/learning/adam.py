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
"""Largest factor of one step on a positive parameter: it reaches its bounds and stays within float32."""


@dataclass(frozen=True)
class Stepped:
    """A parameter with its moments, changed in place, and the rate and range of each column ([1] if it has none).

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
    """Make step `count` (from 1) on every parameter, then clamp it to its range; `decays` are factors on the rates."""
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
    """Adam by an engine, which writes the parameters' memory in place."""

    def __init__(self, new_pass: NewPass, tensors: Sequence[Stepped]) -> None:
        self._new_pass, self._tensors = new_pass, tensors  # kept alive: the engine has their addresses only
        constants = {"count": len(tensors), "beta1": BETA1, "beta2": BETA2, "epsilon": EPSILON}
        self._call = filled("adam", constants | {"groups": [_group(tensor) for tensor in tensors]})
        self._groups = self._call.groups[: len(tensors)]

    def step(self, gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
        """Make a step, like the function `step`."""
        for group, decay in zip(self._groups, decays, strict=True):
            group.decay = decay
        (self._call.beta1_power, self._call.beta2_power), self._call.now = powers(count), None
        self._run(gradients)

    def step_on_device(self, gradients: Sequence[Tensor], decays_and_powers: Float[Tensor, " n"]) -> None:
        """Make a step that reads the decays, then the `powers`, from a tensor on the device (for CUDA graphs)."""
        self._call.now = decays_and_powers.data_ptr()
        self._run(gradients)

    def _run(self, gradients: Sequence[Tensor]) -> None:
        gradients = [gradient.contiguous() for gradient in gradients]  # kept alive until the call is over
        for group, gradient in zip(self._groups, gradients, strict=True):
            group.gradient = gradient.data_ptr()
        self._new_pass().run("adam", self._call)
        self.mark_changed()

    def mark_changed(self) -> None:
        """Notify autograd of the in-place changes, so that a backward pass with old values raises."""
        torch.autograd.graph.increment_version([tensor.value for tensor in self._tensors])


def powers(count: int) -> tuple[float, float]:
    """β₁ and β₂ to the power of `count`: the bias of the moments in step `count`."""
    return BETA1**count, BETA2**count


def _group(tensor: Stepped) -> dict[str, Any]:
    ranges = {"rate": tensor.rates, "low": tensor.low, "high": tensor.high}
    return {
        **{"value": tensor.value, "mean": tensor.mean, "square": tensor.square, "logarithmic": tensor.logarithmic},
        **{"rows": len(tensor.value), "columns": len(tensor.rates)},
        **{name: tuple(numbers.tolist()) for name, numbers in ranges.items()},
    }


class PlainAdam:
    """Adam in plain torch."""

    def __init__(self, tensors: Sequence[Stepped]) -> None:
        self.step = partial(step, tensors)


def stepper(new_pass: NewPass | None, tensors: Sequence[Stepped]) -> EngineAdam | PlainAdam:
    """Adam for these parameters: an engine's if it supports as many columns, else plain torch."""
    columns = max(len(tensor.rates) for tensor in tensors)
    if new_pass is None or not new_pass().has("adam", {"columns": columns}):
        return PlainAdam(tensors)
    return EngineAdam(new_pass, tensors)
