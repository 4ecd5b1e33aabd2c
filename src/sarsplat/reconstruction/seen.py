"""What the radar saw of the Gaussians: from where, over which area, and how bright."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Real
from scipy.spatial import cKDTree

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import render
from sarsplat.unbroken import unbroken

_RAYS_PER_PIXEL = 4.0
_VIEWS_AT_A_TIME = 8
_RADIUS = 0.25  # standard deviation of the weights around a place, resolution cells
_NEIGHBOURS = 16  # Gaussians that count around a place; those farther away weigh next to nothing


@dataclass(frozen=True)
class Seen:
    """Sums over views, for each of N Gaussians."""

    means: Float64[np.ndarray, "n 3"]
    """Centres, world frame, m."""
    cross_section: Float64[np.ndarray, " n"]
    """Radar cross-sections σ, m²."""
    lit_area: Float64[np.ndarray, " n"]
    """Areas across the line of sight over which a Gaussian is seen, m²."""
    towards: Float64[np.ndarray, "n 3"]
    """Directions to the radar, each weighted with that area, m²."""
    radius_m: float
    """Standard deviation of a Gaussian's weight in the space around it, m."""

    @classmethod
    def of(cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid) -> Seen:
        """What these views see of the target's Gaussians, in images on this grid."""
        gaussians, rays = gaussians.detach(), RayGrid.for_image(grid, _RAYS_PER_PIXEL)
        areas, cross_section = [], np.zeros(len(gaussians))
        for first in range(0, len(views), _VIEWS_AT_A_TIME):  # memory stays small
            with torch.no_grad():
                done = render(gaussians, views[first : first + _VIEWS_AT_A_TIME], grid, rays=rays)
            areas.append(done.lit_area.double().cpu().numpy())
            power = done.cross_sections[..., gaussians.scattering.power_channel]
            cross_section += power.double().sum(0).cpu().numpy()
        area = np.concatenate(areas)
        directions = np.stack([view.direction for view in views])
        means = gaussians.means.double().cpu().numpy()
        return cls(means, cross_section, area.sum(0), area.T @ directions, _RADIUS * grid.cell_m)

    def around(self, points: Real[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
        """γ⁰ (linear) around points (m), 0 where nothing was seen, and the mean direction to the radars, of any length.

        γ⁰ is the sum of the cross-sections of the Gaussians there over that of the areas they are seen across: a view
        counts as much as it sees of them.
        """
        if len(self.means) == 0:
            return np.zeros(len(points)), np.zeros((len(points), 3))
        count = min(_NEIGHBOURS, len(self.means))
        distance, index = unbroken(cKDTree(self.means).query, points, k=np.arange(1, count + 1), workers=-1)
        # relative to the nearest: far from every Gaussian, the nearest still speaks
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / self.radius_m**2)
        area = (weight * self.lit_area[index]).sum(1)
        cross_section = (weight * self.cross_section[index]).sum(1)
        gamma0 = np.divide(cross_section, area, out=np.zeros_like(area), where=area > 0)
        return gamma0, np.einsum("pk,pkc->pc", weight, self.towards[index])
