"""Windows: the parts of the images that show a part of the scene, and what else of the scene these parts show.

Something h above the ground appears h·tan ψ nearer to the radar, ψ the grazing angle (layover), and shades h/tan ψ of the
ground behind it. So a window shows, and is darkened by, more than the part that it is for: in each view another
halo, which follows from where Gaussians are, and how high.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.renderer import Rendering, render
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH
from sarsplat.tiles.reach import rows_of

_ON_RAYS = math.sqrt(2 * math.log(MAX_OPTICAL_DEPTH / MIN_RAY_DEPTH))
"""Standard deviations within which a Gaussian touches rays, at most."""


@dataclass(frozen=True)
class Windows:
    """Parts of the images of a dataset, all of one size.

    Parameters
    ----------
    rows, columns : tuple of slice
        The pixels of each image.
    grids : tuple of ImageGrid
        Where these lie.
    """

    rows: tuple[slice, ...]
    columns: tuple[slice, ...]
    grids: tuple[ImageGrid, ...]

    @classmethod
    def around(
        cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, margin_m: float, multiple: int
    ) -> Self:
        """Those that show Gaussians which may yet move by a margin, in whole blocks of multiple × multiple pixels."""
        needed = np.array([_blocks(gaussians, view, grid, margin_m, multiple) for view in views])  # [V, axis, 2]
        most = np.array([grid.columns // multiple, grid.rows // multiple])
        needed = needed.clip(0, most[:, None])
        size = np.maximum((needed[..., 1] - needed[..., 0]).max(axis=0), 1)
        first = np.minimum(needed[..., 0], most - size)
        columns, rows = (
            tuple(slice(int(a) * multiple, int(a + count) * multiple) for a in begins)
            for begins, count in zip(first.T, size, strict=True)
        )
        return cls(rows, columns, tuple(grid.part(r, c) for r, c in zip(rows, columns, strict=True)))

    def of(self, images: Float[Tensor, "v rows columns"]) -> Float[Tensor, "v some few"]:
        """These parts of the images."""
        parts = zip(images, self.rows, self.columns, strict=True)
        return torch.stack([image[rows, columns] for image, rows, columns in parts])

    def shown(
        self, gaussians: Gaussians, views: Sequence[View], rays: RayGrid, ground: Ground | None, margin_m: float
    ) -> Bool[Tensor, " n"]:
        """Which Gaussians any of the windows needs, though they move by a margin."""
        needed = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        for view, grid in zip(views, self.grids, strict=True):
            needed |= _needed(gaussians, view, grid, rays, ground, margin_m)
        return needed

    def render(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        numbers: Sequence[int],
        *,
        rays: RayGrid,
        ground: Ground | None,
        amplitudes: Float[Tensor, "v n c"] | None,
        shift: Float[Tensor, "v 2"] | None,
        **options: Any,
    ) -> Rendering:
        """What `sarsplat.render` shows in the windows of these images, each with the Gaussians that it needs.

        `grid` says what pixels are there; of the windows, only where they lie counts.
        """
        parts = []
        sections = gaussians.means.new_zeros(len(views), len(gaussians), len(gaussians.scattering.channels))
        areas = gaussians.means.new_zeros(len(views), len(gaussians))
        for k, (view, number) in enumerate(zip(views, numbers, strict=True)):
            own = replace(grid, center_m=self.grids[number].center_m)
            index = _needed(gaussians, view, own, rays, ground, 0.0).nonzero()[:, 0]
            part = render(
                rows_of(gaussians, index),
                [view],
                own,
                rays=rays,
                ground=ground,
                amplitudes=None if amplitudes is None else amplitudes[k : k + 1, index],
                shift=None if shift is None else shift[k : k + 1],
                **options,
            )
            parts.append(part.images)
            sections[k, index], areas[k, index] = part.cross_sections[0].detach(), part.lit_area[0]
        return Rendering(torch.cat(parts), sections, areas)


def _blocks(
    gaussians: Gaussians, view: View, grid: ImageGrid, margin_m: float, multiple: int
) -> list[tuple[int, int]]:
    """First block of pixels that shows any of the Gaussians, and the one after the last, along azimuth and range."""
    places, radii = _in_image(gaussians, view, grid)
    ends = []
    for axis, first in enumerate((grid.azimuth_m[0], grid.range_m[0])):
        low = float((places[:, axis] - radii[:, axis]).min()) - margin_m
        high = float((places[:, axis] + radii[:, axis]).max()) + margin_m
        step = grid.spacing_m[axis] * multiple
        edge = first - grid.spacing_m[axis] / 2
        ends.append((math.floor((low - edge) / step), math.ceil((high - edge) / step)))
    return ends


def _in_image(
    gaussians: Gaussians, view: View, grid: ImageGrid
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Where Gaussians appear, and how far from there at most: azimuth and range, m."""
    means, widths = gaussians.means.detach(), gaussians.scales.detach().amax(1, keepdim=True)
    frame = means.new_tensor(radar_frame(view))
    radii = IMAGE_CUT**0.5 * (widths**2 + means.new_tensor(grid.response_variance_m2)).sqrt()
    return means @ frame[::2].T, radii


def _needed(
    gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, ground: Ground | None, margin_m: float
) -> Bool[Tensor, " n"]:
    """Which Gaussians an image shows, and which may shade these or the ground that it shows."""
    places, radii = _in_image(gaussians, view, grid)
    means, widths = gaussians.means.detach(), gaussians.scales.detach().amax(1, keepdim=True)
    on_rays = means @ means.new_tensor(radar_frame(view)[:2]).T
    reach = _ON_RAYS * (widths**2 + CELL_WIDENING * means.new_tensor(rays.spacing_m) ** 2).sqrt() + margin_m
    left, right, far, near = grid.extent_m
    low, high = places - radii - margin_m, places + radii + margin_m
    shown = (high[:, 0] > left) & (low[:, 0] < right) & (high[:, 1] > near) & (low[:, 1] < far)
    corners = [(on_rays - reach)[shown].amin(0), (on_rays + reach)[shown].amax(0)] if shown.any() else []
    if ground is not None:
        azimuth, slant_range = (IMAGE_CUT * variance for variance in grid.response_variance_m2)
        theta = math.radians(view.grazing_deg)
        ends = (near - slant_range**0.5, far + slant_range**0.5)
        below, above = ((r * math.sin(theta) + ground.height_m) / math.cos(theta) for r in ends)
        corners += [means.new_tensor([left - azimuth**0.5, below]), means.new_tensor([right + azimuth**0.5, above])]
    if not corners:
        return shown
    least, most = torch.stack(corners).amin(0), torch.stack(corners).amax(0)
    shades = ((on_rays + reach > least) & (on_rays - reach < most)).all(1)
    return shown | (shades & (low[:, 1] < far))
