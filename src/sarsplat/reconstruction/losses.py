"""What training minimises. Images are β⁰, linear power; amplitude is its root."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from sarsplat.errors import SarsplatError
from sarsplat.renderer import cpu

FLOOR = 1e-3
"""Amplitudes are softened below this share of the reference: the root has no slope at zero."""

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2

_WINDOW = torch.tensor(
    [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2)) for k in range(SSIM_WINDOW)], dtype=torch.float64
)
_WEIGHTS = (_WINDOW / _WINDOW.sum()).float()


def amplitude_loss(
    power: Float32[Tensor, "v rows columns"],
    truth: Float32[Tensor, "v rows columns"],
    reference: float,
    ssim_weight: float,
) -> Float32[Tensor, ""]:
    """(1 − λ)·L1 + λ·(1 − SSIM) on amplitude, √(power / reference² + ε²) − ε; value and gradient in one engine call.

    Parameters
    ----------
    power : Tensor [V, rows, columns]
        Rendered β⁰; differentiable.
    truth : Tensor [V, rows, columns]
        True amplitude, already divided by the reference.
    reference : float
        Amplitude that counts as 1: the largest of the training set.
    ssim_weight : float
        λ. SSIM has a Gaussian window of 11 × 11, σ = 1.5, and counts where the window fits whole.

    Raises
    ------
    SarsplatError
        If the two do not fit together, or SSIM is asked for and the images are smaller than its window.
    """
    for name, tensor in (("power", power), ("truth", truth)):  # the engine reads their memory as such
        if tensor.shape != power.shape or tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise SarsplatError(
                f"{name} is {tensor.dtype} {tuple(tensor.shape)} on {tensor.device}; the loss takes torch.float32 on "
                f"the CPU, both of shape {tuple(power.shape)}"
            )
    if ssim_weight > 0 and min(power.shape[1:]) < SSIM_WINDOW:
        raise SarsplatError(
            f"SSIM needs images of at least {SSIM_WINDOW} × {SSIM_WINDOW} pixels, and these have "
            f"{power.shape[1]} × {power.shape[2]}; take larger ones or a preset without SSIM"
        )
    return _AmplitudeLoss.apply(power, truth, reference, ssim_weight)


class _AmplitudeLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, power: Tensor, truth: Tensor, reference: float, ssim_weight: float) -> Tensor:
        power, truth = power.contiguous(), truth.contiguous()
        value, gradient = power.new_empty(()), torch.empty_like(power)
        pointers = (tensor.data_ptr() for tensor in (power, truth, _WEIGHTS))
        numbers = (reference, FLOOR, ssim_weight, C1, C2)
        cpu.Pass().amplitude_loss(cpu.Loss(*power.shape, *pointers, *numbers, value.data_ptr(), gradient.data_ptr()))
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * slope, None, None, None


def speckle_loss(
    power: Float[Tensor, "v rows columns"], intensity: Float[Tensor, "v rows columns"]
) -> Float[Tensor, ""]:
    """Negative log-likelihood of single-look speckle, nats per pixel: the mean of log S + I / S.

    Parameters
    ----------
    power : Tensor [V, rows, columns]
        Rendered β⁰ with its noise floor, > 0.
    intensity : Tensor [V, rows, columns]
        Measured intensity.
    """
    return _mean(power.log() + intensity / power)


def _mean(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    """One dimension after the other: torch splits a sum to one number by threads, and its bits would depend on them."""
    return images.mean(2).mean(1).mean(0)
