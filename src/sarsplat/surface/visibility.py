"""Per-Gaussian visibility summed over views: lit area, mean γ⁰ and mean direction to the radar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Real
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.progress import stage
from sarsplat.renderer import render
from sarsplat.surface import cells
from sarsplat.surface.first_returns import some_at_once
from sarsplat.surface.neighbours import Neighbours
from sarsplat.uninterruptible import uninterruptible

_RAYS_PER_PIXEL = 4.0
_AT_ONCE = 1 << 18  # places
_RADIUS = 0.25  # standard deviation of the weights around a place, resolution cells
_NEIGHBOURS = 16  # Gaussians that count around a place; those farther away weigh next to nothing


@dataclass(frozen=True)
class Seen:
    """Visibility of each of N Gaussians, summed over views."""

    means: Float64[Tensor, "n 3"]
    """Centres, world frame, m."""
    cross_section: Float64[Tensor, " n"]
    """Radar cross-sections σ, m²."""
    lit_area: Float64[Tensor, " n"]
    """Areas across the line of sight over which a Gaussian is seen, m²."""
    towards: Float64[Tensor, "n 3"]
    """Directions to the radar, each weighted with that area, m²."""
    radius_m: float
    """Standard deviation of a Gaussian's weight in the space around it, m."""

    @classmethod
    def of(cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid) -> Seen:
        gaussians, rays = gaussians.detach(), RayGrid.for_image(grid, _RAYS_PER_PIXEL)
        means, channel = gaussians.means.double(), gaussians.scattering.power_channel
        cross_section, lit_area, towards = (
            means.new_zeros(len(means)),
            means.new_zeros(len(means)),
            torch.zeros_like(means),
        )
        with stage("surface: what each view sees", len(views)) as shown, torch.no_grad():
            for some in some_at_once(gaussians, views, grid, rays):
                done = render(gaussians, some, grid, rays=rays)
                outs = torch.from_numpy(np.stack([view.look.way_out for view in some])).to(means.device)
                for area, section, out in zip(done.lit_area, done.cross_sections, outs, strict=True):
                    lit_area += area.double()
                    towards += area.double()[:, None] * out
                    cross_section += section[:, channel].double()
                shown.advance(len(some))
        return cls(means, cross_section, lit_area, towards, _RADIUS * grid.cell_m)

    def around(self, points: Real[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
        """γ⁰ (linear) around points (m), 0 where nothing was seen, and the mean direction to the radars, of any length.

        γ⁰ is the sum of the cross-sections of the Gaussians there over that of the areas they are seen across: a view
        counts as much as it sees of them.
        """
        gamma0, towards = np.zeros(len(points)), np.zeros((len(points), 3))
        count = min(_NEIGHBOURS, len(self.means))
        if not count or not len(points):
            return gamma0, towards
        if not cells.on_cpu(self.means):
            return self._around(torch.from_numpy(points).to(self.means), count)
        means, lit_area, cross_sections, ways = (
            tensor.numpy() for tensor in (self.means, self.lit_area, self.cross_section, self.towards)
        )
        tree = cKDTree(means)
        for first in range(0, len(points), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            distance, index = uninterruptible(tree.query, points[part], k=np.arange(1, count + 1), workers=-1)
            # relative to the nearest: far from every Gaussian, the nearest still speaks
            weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / self.radius_m**2)
            area = (weight * lit_area[index]).sum(1)
            cross_section = (weight * cross_sections[index]).sum(1)
            np.divide(cross_section, area, out=gamma0[part], where=area > 0)
            towards[part] = np.einsum("pk,pkc->pc", weight, ways[index])
        return gamma0, towards

    def _around(
        self, places: Float64[Tensor, "p 3"], count: int
    ) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
        """The same where the Gaussians are."""
        found, near = [], Neighbours(self.means)
        for some in places.split(_AT_ONCE):
            square, index = near.nearest(some, count)
            weight = torch.exp(-0.5 * (square - square[:, :1]) / self.radius_m**2)
            area, section = ((weight * each[index]).sum(1) for each in (self.lit_area, self.cross_section))
            gamma0 = (section / area).where(area > 0, 0.0)
            found.append(torch.cat([gamma0[:, None], (weight[..., None] * self.towards[index]).sum(1)], dim=1))
        seen = torch.cat(found).cpu().numpy()
        return seen[:, 0], seen[:, 1:]
