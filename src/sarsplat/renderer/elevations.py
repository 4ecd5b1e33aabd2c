"""Complex cross-sections of pairs of channels, with phases of elevations, and how these change across footprints."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.geometry import View, radar_frame
from sarsplat.renderer.engines import cpu
from sarsplat.renderer.engines.choice import chosen_engine
from sarsplat.renderer.engines.structs import Sections
from sarsplat.renderer.footprints import Footprints
from sarsplat.renderer.once import differentiable_once


def elevated(
    gaussians: Gaussians,
    views: Sequence[View],
    pixels: Footprints,
    numbers: Float64[np.ndarray, "v d"],
    real: Float[Tensor, "v n d"] | Float[Tensor, "v n 1"],
    imaginary: Float[Tensor, "v n d"] | None,
    engine: str,
) -> tuple[Float[Tensor, "v n k"], Float[Tensor, "v n 2"]]:
    """Cross-sections with the phases at the centres of footprints, and the elevation per displacement from there.

    Given the pixel at the displacement d from the centre of a footprint, scatterers are distributed around μ + K d with
    the covariance Σ − K J Σ, where K = Σ Jᵀ (J Σ Jᵀ + response)⁻¹ and J projects on the imaging plane; of these, only
    the elevation counts. The inverse is that of the footprint.

    Parameters
    ----------
    gaussians, views, pixels
        N Gaussians, V views, and the footprints on the imaging plane.
    numbers : numpy.ndarray, float64 [V, D]
        Phase per elevation of each pair, rad/m.
    real, imaginary : Tensor [V, N, D]
        Cross-sections as if all were at one place; of the real part perhaps one for all pairs, the other perhaps zero.
    engine : str
        As at `render`.

    Returns
    -------
    Tensor [V, N, 2 D], Tensor [V, N, 2]
        Real and imaginary parts in turn, m²; and m per m.
    """
    means, roots = gaussians.means, pixels.roots
    frames = torch.from_numpy(np.stack([radar_frame(view) for view in views])).to(means)  # [V, 3, 3]
    kappa = torch.from_numpy(numbers).to(means)
    assert real.shape[2] in (1, kappa.shape[1])
    if chosen_engine(engine, means) == "cpu":
        inputs = (means, gaussians.quaternions, gaussians.scales, roots, real, imaginary)
        parts, slopes = _Engine.apply(frames, kappa, *inputs)
        return parts, slopes
    sides = frames[:, None] @ (rotation_matrix(gaussians.quaternions) * gaussians.scales[:, None])  # Σ is their square
    yx, yy, yz = (sides[:, :, 1:2] * sides).sum(-1).unbind(-1)
    a, b, c = roots.unbind(-1)
    mixed = a * b
    slopes = torch.stack([a * a * yx + mixed * yz, mixed * yx + (b * b + c * c) * yz], dim=-1)
    variance = (yy - slopes[..., 0] * yx - slopes[..., 1] * yz).clamp(min=0)
    phase = (frames[:, 1] @ means.T)[..., None] * kappa[:, None]
    left = torch.exp(variance[..., None] * (-0.5 * kappa[:, None] ** 2))
    cosine, sine = left * phase.cos(), left * phase.sin()
    if imaginary is None:
        turned = real * cosine, real * sine
    else:
        turned = real * cosine - imaginary * sine, real * sine + imaginary * cosine
    return torch.stack(turned, dim=-1).flatten(2), slopes


class _Engine(torch.autograd.Function):
    """The same by the CPU engine; differentiable once."""

    @staticmethod
    def forward(ctx: Any, frames: Tensor, numbers: Tensor, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
        kept = [None if tensor is None else tensor.contiguous() for tensor in (frames, numbers, *inputs)]
        ctx.save_for_backward(*kept)
        real = kept[6]
        assert real is not None  # of each Gaussian
        v, n, d = real.shape[0], real.shape[1], numbers.shape[1]
        parts, slopes = real.new_empty(v, n, 2 * d), real.new_empty(v, n, 2)
        cpu.Pass().pair_sections(_problem(kept, parts, slopes))
        return parts, slopes

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *seeds: Tensor) -> tuple[Tensor | None, ...]:
        kept = list(ctx.saved_tensors)
        gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in kept[2:]]
        seeds = tuple(seed.contiguous() for seed in seeds)
        cpu.Pass().pair_sections_backward(_problem(kept, None, None, *seeds, *gradients))
        return None, None, *gradients


def _problem(kept: Sequence[Tensor | None], *others: Tensor | None) -> Structure:
    """Inputs as `forward` has them, then outputs, seeds and gradients."""
    frames, numbers, means, quaternions, scales, roots, real, imaginary = kept
    assert real is not None  # of each Gaussian
    assert numbers is not None
    pointers = [means, quaternions, scales, frames, roots, numbers, real, imaginary, *others]
    return Sections(
        real.shape[0],
        numbers.shape[1],
        real.shape[1],
        int(real.shape[2] == 1),
        *(None if tensor is None else tensor.data_ptr() for tensor in pointers),
    )
