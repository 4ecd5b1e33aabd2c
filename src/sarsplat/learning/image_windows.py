"""Image windows: the part of each image that shows a part of the scene, and the Gaussians needed to render it.

Something h above the ground appears h·tan ψ nearer to the radar, ψ the grazing angle (layover), and shades h/tan ψ of
the ground behind it. So a window also needs Gaussians around its part of the scene, others in each view.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians, Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.renderer import Rendering, render
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH

_ON_RAYS = math.sqrt(2 * math.log(MAX_OPTICAL_DEPTH / MIN_RAY_DEPTH))  # reach of a Gaussian, standard deviations
_IN_IMAGE = math.sqrt(IMAGE_CUT)  # reach of a Gaussian in pixels, standard deviations


@dataclass(frozen=True)
class Windows:
    """A part of each image of a dataset; stacked, they are padded with black to the size of the largest."""

    rows: tuple[slice, ...]
    columns: tuple[slice, ...]
    """The pixels of each image."""
    grids: tuple[ImageGrid, ...]

    @classmethod
    def around(
        cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, margin_m: float, multiple: int
    ) -> Self:
        """Windows around Gaussians that may move by a margin, in whole blocks of multiple × multiple pixels."""
        check_unstretched(views, "give tiles 1")
        sides = [_pixels(gaussians, view, grid, margin_m, multiple) for view in views]
        columns, rows = zip(*sides, strict=True)
        return cls(rows, columns, tuple(grid.part(r, c) for r, c in zip(rows, columns, strict=True)))

    @property
    def stack(self) -> ImageGrid:
        """Grid of the stacked parts; its centre has no meaning."""
        rows, columns = (max(getattr(grid, name) for grid in self.grids) for name in ("rows", "columns"))
        return replace(self.grids[0], rows=rows, columns=columns)

    def of(self, images: Float[Tensor, "v rows columns"]) -> Float[Tensor, "v m n"]:
        """Cut the windows out of the images, and stack them."""
        parts = zip(images, self.rows, self.columns, strict=True)
        return torch.stack([_filled(image[rows, columns], self.stack) for image, rows, columns in parts])

    def shown(
        self, gaussians: Gaussians, views: Sequence[View], rays: RayGrid, ground: Ground | None, margin_m: float
    ) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that any window needs, even if they move by a margin."""
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
        """Render the windows of these images, stacked, each with the Gaussians that it needs.

        `grid` is `stack`, or `stack` with larger pixels.
        """
        parts, tensors = [], gaussians.tensors()
        sections = gaussians.means.new_zeros(len(views), len(gaussians), len(gaussians.scattering.channels))
        areas = gaussians.means.new_zeros(len(views), len(gaussians))
        for k, (view, number) in enumerate(zip(views, numbers, strict=True)):
            window, stack = self.grids[number], self.stack
            rows, columns = window.rows * grid.rows // stack.rows, window.columns * grid.columns // stack.columns
            own = replace(grid, rows=rows, columns=columns, center_m=window.center_m)
            index = _needed(gaussians, view, own, rays, ground, margin_m=0.0).nonzero()[:, 0]
            part = render(
                gaussians.with_tensors(**{name: tensor.index_select(0, index) for name, tensor in tensors.items()}),
                [view],
                own,
                rays=rays,
                ground=ground,
                amplitudes=None if amplitudes is None else amplitudes[k : k + 1, index],
                shift=None if shift is None else shift[k : k + 1],
                **options,
            )
            parts.append(_filled(part.images, grid))
            sections[k, index], areas[k, index] = part.cross_sections[0].detach(), part.lit_area[0]
        return Rendering(torch.cat(parts), sections, areas)


def _filled(image: Float[Tensor, "*c rows columns"], grid: ImageGrid) -> Float[Tensor, "*c {grid.rows} {grid.columns}"]:
    """An image part padded with black pixels."""
    rows, columns = image.shape[-2:]
    return pad(image, (0, grid.columns - columns, 0, grid.rows - rows))


def _pixels(gaussians: Gaussians, view: View, grid: ImageGrid, margin_m: float, multiple: int) -> tuple[slice, slice]:
    """Columns and rows that show any of the Gaussians, in whole blocks; at least one block."""
    means, widths = gaussians.means.detach(), gaussians.scales.detach().amax(1)
    x, z = means.new_tensor(view.look.gradients) @ means.T
    sides, (left, _, _, near) = [], grid.extent_m
    for axis, (places, first, count) in enumerate(((x, left, grid.columns), (z, near, grid.rows))):
        low, high = _extent(places, widths, _IN_IMAGE, grid.response_variance_m2[axis], margin_m)
        step, blocks = grid.spacing_m[axis] * multiple, count // multiple
        begin = min(max(math.floor((float(low.min()) - first) / step), 0), blocks - 1)
        end = min(max(math.ceil((float(high.max()) - first) / step), begin + 1), blocks)
        sides.append(slice(begin * multiple, end * multiple))
    return sides[0], sides[1]


def _extent(
    places: Float[Tensor, " n"], widths: Float[Tensor, " n"], deviations: float, variance_m2: float, margin_m: float
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Bounds of footprints along an axis, m, from the widest axis of each Gaussian."""
    reach = (widths**2 + variance_m2).sqrt() * deviations + margin_m
    return places - reach, places + reach


def _needed(
    gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, ground: Ground | None, margin_m: float
) -> Bool[Tensor, " n"]:
    """Mask of the Gaussians that an image shows, and of those that may occlude them or the ground in it."""
    means, widths = gaussians.means.detach(), gaussians.scales.detach().amax(1)
    x, y, z = means.new_tensor(view.look.frame) @ means.T
    variances, cells = grid.response_variance_m2, [CELL_WIDENING * spacing**2 for spacing in rays.spacing_m]
    begins, ends = _extent(x, widths, _IN_IMAGE, variances[0], margin_m)
    nearest, farthest = _extent(z, widths, _IN_IMAGE, variances[1], margin_m)
    left, right, far, near = grid.extent_m
    on_ground = None
    if ground is not None:  # x_r and y_r of the rays that end on the ground in the image
        azimuth, slant_range = (_IN_IMAGE * variance**0.5 for variance in variances)
        across, away = (left - azimuth, right + azimuth), (near - slant_range, far + slant_range)
        on_ground = view.look.rays_to_ground(across, away, ground.span_m)
    before = nearest < far
    shown = (ends > left) & (begins < right) & (farthest > near) & before
    for axis, (places, cell) in enumerate(zip((x, y), cells, strict=True)):
        low, high = _extent(places, widths, _ON_RAYS, cell, margin_m)
        sides = [low[shown].amin(), high[shown].amax()] if shown.any() else []
        sides += [] if on_ground is None else [means.new_tensor(side) for side in on_ground[axis]]
        if sides:
            before = before & (high > torch.stack(sides).amin()) & (low < torch.stack(sides).amax())
    return shown | before if shown.any() or ground is not None else shown
