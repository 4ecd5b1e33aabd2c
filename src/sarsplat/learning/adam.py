"""One step of Adam: by an engine, or in plain torch on any device, without waiting for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from ctypes import Structure
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.renderer import cpu, cuda, structs
from sarsplat.renderer.cuda_device import gpu_of

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15

_LARGEST_FACTOR = 2.0**99
"""By which one step may change a positive parameter: its bounds are reached, and float32 is not left."""


_MAX_COLUMNS = len(structs.AdamGroup().rate)


def engine_takes(tensors: Iterable[Tensor]) -> bool:
    """Whether the CPU engine can compute with these: float32 on the CPU, tables of at most 16 columns."""
    own = list(tensors)
    return _engines_compute(own) and all(tensor.is_cpu for tensor in own)


def engine_for(tensors: Sequence[Tensor]) -> Callable[[Structure], None] | None:
    """What steps these parameters: the engine of their device, or None for plain torch."""
    if engine_takes(tensors):
        return cpu.adam
    gpu = gpu_of(tensors) if _engines_compute(tensors) else None
    return None if gpu is None else partial(cuda.adam, gpu)


def _engines_compute(tensors: Iterable[Tensor]) -> bool:
    """Whether these are float32, and tables of at most 16 columns."""
    return all(t.dtype == torch.float32 and (t.ndim != 2 or t.shape[1] <= _MAX_COLUMNS) for t in tensors)


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
    """`step` on parameters of at most 16 columns, whose memory an engine writes in place: `engine_for` theirs."""

    def __init__(self, engine: Callable[[Structure], None], tensors: Sequence[Stepped]) -> None:
        self._engine, self._tensors = engine, tensors  # kept alive: the engine has their addresses only
        self._groups = (structs.AdamGroup * len(tensors))()
        for group, tensor in zip(self._groups, tensors):
            group.value, group.mean, group.square = (t.data_ptr() for t in (tensor.value, tensor.mean, tensor.square))
            columns = len(tensor.rates)
            group.rows, group.columns = len(tensor.value), columns
            group.logarithmic = tensor.logarithmic
            group.rate[:columns], group.low[:columns], group.high[:columns] = (
                numbers.tolist() for numbers in (tensor.rates, tensor.low, tensor.high)
            )

    def step(self, gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
        """One step, as by the function `step`."""
        gradients = [gradient.contiguous() for gradient in gradients]  # kept alive until the call is over
        for group, gradient, decay in zip(self._groups, gradients, decays, strict=True):
            group.gradient, group.decay = gradient.data_ptr(), decay
        powers = BETA1**count, BETA2**count
        self._engine(structs.AdamStep(self._groups, len(self._groups), BETA1, BETA2, EPSILON, *powers))
        # the engine wrote behind torch's back: whoever kept the old values for a backward pass is notified
        torch.autograd.graph.increment_version([tensor.value for tensor in self._tensors])
