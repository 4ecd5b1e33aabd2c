"""What training minimises. Images are β⁰, linear power; amplitude is its root."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

_FLOOR = 1e-3
"""Amplitudes are softened below this share of the reference: the root has no slope at zero."""

_SSIM_WINDOW = 11
_SSIM_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def amplitude(power: Float[Tensor, "*shape"], reference: float) -> Float[Tensor, "*shape"]:
    """√power / reference, softened near zero: 0 stays 0 and the slope stays finite; [...] → [...]."""
    return (power / reference**2 + _FLOOR**2).sqrt() - _FLOOR


def amplitude_loss(
    power: Float[Tensor, "v rows columns"], truth: Float[Tensor, "v rows columns"], reference: float, ssim_weight: float
) -> Float[Tensor, ""]:
    """(1 − λ)·L1 + λ·(1 − SSIM) on amplitude.

    Parameters
    ----------
    power : Tensor [V, rows, columns]
        Rendered β⁰.
    truth : Tensor [V, rows, columns]
        True amplitude, already divided by the reference.
    reference : float
        Amplitude that counts as 1: the largest of the training set.
    ssim_weight : float
        λ.
    """
    rendered = amplitude(power, reference)
    absolute = _mean((rendered - truth).abs())
    if ssim_weight == 0:
        return absolute
    return (1 - ssim_weight) * absolute + ssim_weight * (1 - ssim(rendered, truth))


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


def ssim(a: Float[Tensor, "v rows columns"], b: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    """Mean structural similarity of images in [0, 1], [V, rows, columns]; Gaussian window 11 × 11, σ = 1.5."""
    x = torch.arange(_SSIM_WINDOW, dtype=a.dtype, device=a.device) - _SSIM_WINDOW // 2
    window = torch.exp(-(x**2) / (2 * _SSIM_SIGMA**2))
    window = window / window.sum()
    maps = torch.stack([a, b, a * a, b * b, a * b], dim=1).flatten(0, 1)[:, None]
    maps = conv2d(conv2d(maps, window[None, None, :, None]), window[None, None, None, :])
    mean_a, mean_b, aa, bb, ab = maps.view(len(a), 5, *maps.shape[-2:]).unbind(1)
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + _C1) * (2 * cov + _C2)
    return _mean(similarity / ((mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)))


def _mean(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    """One dimension after the other: torch splits a sum to one number by threads, and its bits would depend on them."""
    return images.mean(2).mean(1).mean(0)
