"""Relocation: idle Gaussians take over half of strong ones, so that few are enough."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.reconstruction.config import Relocation
from sarsplat.reconstruction.rounds import at_round

_OWN_PART = 0.6
"""Of the optical depth, for each of the two: with 0.5 and 0.7 reconstructions were worse (docs/reconstruction.md)."""


def due(config: Relocation, iteration: int, iterations: int) -> bool:
    """Whether a round follows this iteration."""
    return config.rounds > 0 and iteration > 0 and at_round(iteration, 0, config.until * iterations, config.rounds)


def pairs(
    cross_sections: Float[Tensor, " n"], idle_share: float, generator: torch.Generator
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]:
    """Which Gaussians are idle, and which strong ones they join, each its own; a strong one is likely to be joined.

    Parameters
    ----------
    cross_sections : Tensor [N]
        Radar cross-sections σ, mean over the training views, m²; on any device.
    idle_share : float
        Idle are the weakest that together have at most this share of the total.
    generator : torch.Generator
        Of the CPU.

    Returns
    -------
    idle, strong : Tensor, int64 [M]
        On the CPU; no number is in both.
    """
    sigma = cross_sections.double().cpu()
    order = sigma.argsort(stable=True)
    held = sigma[order].cumsum(0)
    idle = order[held <= idle_share * held[-1]][: len(order) // 2]
    weights = sigma.index_fill(0, idle, 0.0)
    idle = idle[: int((weights > 0).sum())]
    if not len(idle):
        return idle, idle
    return idle, torch.multinomial(weights, len(idle), generator=generator)


def halve(
    gaussians: Gaussians, strong: Int64[Tensor, " m"], generator: torch.Generator
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, " m"]]:
    """How to make two of each strong Gaussian: one stands this far ahead of its centre, the other as far behind it.

    Parameters
    ----------
    gaussians : Gaussians
        All of them.
    strong : Tensor, int64 [M]
        Which.
    generator : torch.Generator
        Of the CPU.

    Returns
    -------
    displacement : Tensor [M, 3]
        m.
    optical_depth : Tensor [M]
        Of each half.
    """
    along = (
        torch.randn(len(strong), 3, generator=generator, device="cpu").to(gaussians.means) * gaussians.scales[strong]
    )
    displacement = (rotation_matrix(gaussians.quaternions[strong]) @ along[:, :, None])[:, :, 0]
    return displacement, _OWN_PART * gaussians.optical_depth[strong]
