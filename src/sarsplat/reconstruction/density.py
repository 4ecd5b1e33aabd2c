"""Density control as in 3D Gaussian splatting, with the paper's thresholds: clone, split, prune."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.geometry import ImageGrid
from sarsplat.reconstruction.config import Densification
from sarsplat.renderer import Rendering

_SPLIT_SHRINK = 1.6
"""A split Gaussian's two parts are this much smaller."""


class DensityControl:
    """Gathers gradients on the planes and, every so often, decides which Gaussians come and go."""

    def __init__(self, config: Densification, count: int, device: torch.device | str = "cpu") -> None:
        self._config = config
        self.gradient = torch.zeros(count, device=device)  # sums over the views that lit a Gaussian
        self.seen = torch.zeros(count, device=device)

    def wanted(self, iteration: int) -> bool:
        """Whether gradients of this iteration count."""
        return iteration < self._config.stop

    def gather(self, rendering: Rendering, grid: ImageGrid) -> None:
        """Add one step's gradients, after backward. Rows beyond the target's (the ground) are not asked."""
        assert rendering.plane_gradients is not None
        n = len(self.gradient)
        half = 0.5 * grid.columns * grid.spacing_m[0]  # per half image width: the unit of 3DGS's threshold
        slopes = rendering.plane_gradients[:, :n]
        total = torch.stack([slopes[..., 0] + slopes[..., 2], slopes[..., 1], slopes[..., 3]], dim=-1)
        lit = (rendering.lit_area[:, :n] > 0).float()
        self.gradient += (total.norm(dim=-1) * half * lit).sum(0)
        self.seen += lit.sum(0)

    def due(self, iteration: int) -> bool:
        """Whether to act after this iteration."""
        c = self._config
        return c.start <= iteration < c.stop and iteration % c.every == 0

    def decide(
        self, gaussians: Gaussians, grid: ImageGrid, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the next generation of Gaussians is.

        Parameters
        ----------
        gaussians : Gaussians
            The present ones.
        grid : ImageGrid
            Of the images: its resolution cell and its extent in range are what sizes are compared with.
        generator : torch.Generator
            Of the CPU; places the parts of split Gaussians.

        Returns
        -------
        source : Tensor, int64 [M]
            Row each new Gaussian is made from.
        kept : Tensor, bool [M]
            Whether it is that Gaussian itself, unchanged.
        displacement : Tensor [M, 3]
            How far its centre moves, m.
        shrink : Tensor [M]
            Factor on its standard deviations.

        Raises
        ------
        SarsplatError
            If none would be left.
        """
        c = self._config
        n, device = len(gaussians), gaussians.means.device
        size = gaussians.scales.max(dim=1).values
        # the part that is the same in all directions: what a law without its details says in any of them
        plain = replace(gaussians, scattering=gaussians.scattering.detailed(0))
        scattering = plain.gamma0(gaussians.means.new_tensor([[0.0, 0.0, 1.0]]))[0]
        pruned = (scattering * -torch.expm1(-gaussians.optical_depth) < c.min_scattering) | (
            size > c.max_extent * grid.rows * grid.spacing_m[1]
        )
        if bool(pruned.all()):
            raise SarsplatError(
                f"density control would remove all Gaussians: none scatters at least {c.min_scattering:g} "
                f"(densification.min_scattering) and is smaller than {c.max_extent:g} of the range "
                "(densification.max_extent); lower the first or raise the second"
            )
        grows = (self.gradient / self.seen.clamp(min=1) > c.gradient) & ~pruned
        room = max(0, c.max_gaussians - n)
        if int(grows.sum()) > room:  # the strongest first
            strongest = torch.where(grows, self.gradient / self.seen.clamp(min=1), 0.0).argsort(
                descending=True, stable=True
            )
            grows = torch.zeros_like(grows).index_fill(0, strongest[:room], True)
        split = grows & (size > c.split_above * grid.cell_m)
        stay = (~pruned & ~split).nonzero()[:, 0]
        clones = (grows & ~split).nonzero()[:, 0]
        parts = split.nonzero()[:, 0].repeat(2)
        offset = torch.randn(len(parts), 3, generator=generator, device="cpu").to(device) * gaussians.scales[parts]
        offset = (rotation_matrix(gaussians.quaternions[parts]) @ offset[:, :, None])[:, :, 0]
        source = torch.cat([stay, clones, parts])
        kept = torch.arange(len(source), device=device) < len(stay)
        displacement = torch.zeros(len(source), 3, device=device)
        displacement[len(stay) + len(clones) :] = offset
        shrink = torch.ones(len(source), device=device)
        shrink[len(stay) + len(clones) :] = 1 / _SPLIT_SHRINK
        self.gradient, self.seen = torch.zeros(2, len(source), device=device)
        return source, kept, displacement, shrink
