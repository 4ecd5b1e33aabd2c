"""One step of Adam in plain torch, on any device and without waiting for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15

_LARGEST_FACTOR = 2.0**99
"""By which one step may change a positive parameter: its bounds are reached, and float32 is not left."""


@dataclass(frozen=True)
class Stepped:
    """A parameter, its moments, and what holds for each of its columns; all on one device and of one floating dtype.

    Parameters
    ----------
    value, mean, square : Tensor [rows] or [rows, columns]
        Changed in place.
    rates, low, high : Tensor [columns]
        Learning rates, and the range that values are brought back into; [1] for a value without columns.
    logarithmic : bool
        Step the logarithm of a positive value.
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
    """One update of every parameter, and back into its range.

    Parameters
    ----------
    tensors : sequence of Stepped
        The parameters.
    gradients : sequence of Tensor
        Of the loss with respect to each value.
    decays : sequence of float
        Factor on the rates of each.
    count : int
        How many updates this one makes, from 1: moments that began at zero are corrected for it.
    """
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
