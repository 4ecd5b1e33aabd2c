"""Complex cross-sections of pairs of channels, with phases of elevations, and how these change across footprints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.geometry import View
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.footprints import Footprints


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
    frames = torch.from_numpy(np.stack([view.look.frame for view in views])).to(means)  # [V, 3, 3]
    kappa = torch.from_numpy(numbers).to(means)
    assert real.shape[2] in (1, kappa.shape[1])
    inputs = (means, gaussians.quaternions, gaussians.scales, frames, roots, kappa, real, imaginary)
    named = dict(zip(Sections.names, inputs, strict=True))
    return Sections().on(passes_for(engine, named), *inputs)


class Sections(Operation):
    """`elevated`, given the radar frames of the views."""

    operation = "pair_sections"
    names = ("means", "quaternions", "scales", "frames", "roots", "numbers", "real", "imaginary")

    def plain(
        self,
        means: Float[Tensor, "n 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        frames: Float[Tensor, "v 3 3"],
        roots: Float[Tensor, "v n 3"],
        numbers: Float[Tensor, "v d"],
        real: Float[Tensor, "v n d"] | Float[Tensor, "v n 1"],
        imaginary: Float[Tensor, "v n d"] | None,
    ) -> tuple[Float[Tensor, "v n k"], Float[Tensor, "v n 2"]]:
        sides = frames[:, None] @ (rotation_matrix(quaternions) * scales[:, None])  # Σ is their square
        yx, yy, yz = (sides[:, :, 1:2] * sides).sum(-1).unbind(-1)
        a, b, c = roots.unbind(-1)
        mixed = a * b
        slopes = torch.stack([a * a * yx + mixed * yz, mixed * yx + (b * b + c * c) * yz], dim=-1)
        variance = (yy - slopes[..., 0] * yx - slopes[..., 1] * yz).clamp(min=0)
        phase = (frames[:, 1] @ means.T)[..., None] * numbers[:, None]
        left = torch.exp(variance[..., None] * (-0.5 * numbers[:, None] ** 2))
        cosine, sine = left * phase.cos(), left * phase.sin()
        if imaginary is None:
            turned = real * cosine, real * sine
        else:
            turned = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        return torch.stack(turned, dim=-1).flatten(2), slopes

    def numbers(self, *inputs: Tensor) -> dict[str, Any]:
        pairs, (views, gaussians, parts) = inputs[5].shape[1], inputs[6].shape
        return {"views": views, "pairs": pairs, "gaussians": gaussians, "shared": int(parts == 1)}

    def outputs(self, *inputs: Tensor) -> dict[str, Tensor]:
        real, pairs = inputs[6], inputs[5].shape[1]
        parts = real.new_empty(*real.shape[:2], 2 * pairs)
        return {"parts": parts, "slopes": real.new_empty(*real.shape[:2], 2)}
