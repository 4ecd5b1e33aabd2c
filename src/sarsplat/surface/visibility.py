"""Per-Gaussian visibility summed over views: lit area, mean γ⁰ and mean direction to the radar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Real
from scipy.spatial import cKDTree

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.progress import stage
from sarsplat.renderer import render
from sarsplat.uninterruptible import uninterruptible

_RAYS_PER_PIXEL = 4.0
_AT_ONCE = 1 << 18  # places
_RADIUS = 0.25  # standard deviation of the weights around a place, resolution cells
_NEIGHBOURS = 16  # Gaussians that count around a place; those farther away weigh next to nothing


@dataclass(frozen=True)
class Seen:
    """Visibility of each of N Gaussians, summed over views."""

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
        gaussians, rays = gaussians.detach(), RayGrid.for_image(grid, _RAYS_PER_PIXEL)
        cross_section, lit_area, towards = (
            np.zeros(len(gaussians)),
            np.zeros(len(gaussians)),
            np.zeros(gaussians.means.shape),
        )
        with stage("surface: what each view sees", len(views)) as shown, torch.no_grad():
            for view in views:  # memory stays small
                done = render(gaussians, [view], grid, rays=rays)
                area = done.lit_area[0].double().cpu().numpy()
                lit_area += area
                towards += area[:, None] * view.look.way_out
                cross_section += done.cross_sections[0, :, gaussians.scattering.power_channel].double().cpu().numpy()
                shown.advance(1)
        return cls(gaussians.means.double().cpu().numpy(), cross_section, lit_area, towards, _RADIUS * grid.cell_m)

    def around(self, points: Real[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
        """γ⁰ (linear) around points (m), 0 where nothing was seen, and the mean direction to the radars, of any length.

        γ⁰ is the sum of the cross-sections of the Gaussians there over that of the areas they are seen across: a view
        counts as much as it sees of them.
        """
        gamma0, towards = np.zeros(len(points)), np.zeros((len(points), 3))
        count = np.arange(1, min(_NEIGHBOURS, len(self.means)) + 1)
        tree = cKDTree(self.means)
        for first in range(0, len(points) if len(count) else 0, _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            distance, index = uninterruptible(tree.query, points[part], k=count, workers=-1)
            # relative to the nearest: far from every Gaussian, the nearest still speaks
            weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / self.radius_m**2)
            area = (weight * self.lit_area[index]).sum(1)
            cross_section = (weight * self.cross_section[index]).sum(1)
            np.divide(cross_section, area, out=gamma0[part], where=area > 0)
            towards[part] = np.einsum("pk,pkc->pc", weight, self.towards[index])
        return gamma0, towards
