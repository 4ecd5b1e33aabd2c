"""Loss and Adam in one call of the CPU engine each: drop-ins for the plain torch of `losses` and `adam`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from sarsplat.reconstruction.adam import BETA1, BETA2, EPSILON, Stepped
from sarsplat.renderer import cpu, structs
from sarsplat.renderer.once import differentiable_once

_MAX_COLUMNS = len(structs.AdamGroup().rate)


def takes(tensors: Iterable[Tensor]) -> bool:
    """Whether the CPU engine can compute with these: float32 on the CPU, tables of at most 16 columns."""
    return all(
        tensor.dtype == torch.float32
        and tensor.device.type == "cpu"
        and (tensor.ndim != 2 or tensor.shape[1] <= _MAX_COLUMNS)
        for tensor in tensors
    )


class AmplitudeLoss(torch.autograd.Function):
    """`losses.plain_amplitude_loss`, value and gradient in one go; differentiable once, with respect to `power`."""

    @staticmethod
    def forward(ctx: Any, power: Tensor, truth: Tensor, window: Tensor, *numbers: float) -> Tensor:
        """Both images, the window's weights, and reference, floor, λ, C1, C2."""
        power, truth = power.contiguous(), truth.contiguous()
        value, gradient = power.new_empty(()), torch.empty_like(power)
        pointers = (tensor.data_ptr() for tensor in (power, truth, window))
        cpu.Pass().amplitude_loss(
            structs.Loss(*power.shape, *pointers, *numbers, value.data_ptr(), gradient.data_ptr())
        )
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Only `power` has a gradient."""
        (gradient,) = ctx.saved_tensors
        return gradient * slope, *[None] * 7


class Adam:
    """`adam.step` on parameters of at most 16 columns, whose memory the engine writes in place."""

    def __init__(self, tensors: Sequence[Stepped]) -> None:
        self._tensors = tensors  # kept alive: the engine has their addresses only
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
        """See `adam.step`."""
        gradients = [gradient.contiguous() for gradient in gradients]  # kept alive until the call is over
        for group, gradient, decay in zip(self._groups, gradients, decays, strict=True):
            group.gradient, group.decay = gradient.data_ptr(), decay
        powers = BETA1**count, BETA2**count
        cpu.adam(structs.AdamStep(self._groups, len(self._groups), BETA1, BETA2, EPSILON, *powers))
        # the engine wrote behind torch's back: whoever kept the old values for a backward pass is told
        torch.autograd.graph.increment_version([tensor.value for tensor in self._tensors])
