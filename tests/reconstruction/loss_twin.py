"""The amplitude loss in plain torch, differentiated by autograd: what the engine's is judged by."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from sarsplat.reconstruction.losses import C1, C2, FLOOR, SSIM_SIGMA, SSIM_WINDOW


def amplitude_loss(power: Tensor, truth: Tensor, reference: float, ssim_weight: float) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM) on amplitude; any dtype."""
    rendered = (power / reference**2 + FLOOR**2).sqrt() - FLOOR
    absolute = (rendered - truth).abs().mean()
    if ssim_weight == 0:
        return absolute
    return (1 - ssim_weight) * absolute + ssim_weight * (1 - ssim(rendered, truth))


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of images in [0, 1], [V, rows, columns], where the window fits whole."""
    x = torch.arange(SSIM_WINDOW, dtype=a.dtype) - SSIM_WINDOW // 2
    window = torch.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    maps = torch.stack([a, b, a * a, b * b, a * b], dim=1).flatten(0, 1)[:, None]
    maps = conv2d(conv2d(maps, window[None, None, :, None]), window[None, None, None, :])
    mean_a, mean_b, aa, bb, ab = maps.view(len(a), 5, *maps.shape[-2:]).unbind(1)
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + C1) * (2 * cov + C2)
    return (similarity / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))).mean()
