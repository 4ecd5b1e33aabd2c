"""Sums along a ranking, the same bits each time on every device."""

from __future__ import annotations

import torch
from jaxtyping import Float64
from torch import Tensor

_TOTAL = 2.0**61
"""Of whole numbers that stand for values."""


def running_sums(values: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """The sum of each value and all before it; none is negative.

    A GPU adds floating-point numbers in an order that differs from run to run, so there they become whole numbers.
    """
    if values.device.type == "cpu":
        return values.cumsum(0)
    return whole_sums(values)


def whole_sums(values: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """The same, rounded to 2⁻⁶¹ of the total, whatever the order of the additions."""
    scale = _TOTAL / values.sum().clamp(min=torch.finfo(values.dtype).tiny * _TOTAL)
    return (values * scale).long().cumsum(0).double() / scale
