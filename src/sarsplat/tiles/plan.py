"""Plan of tiles for an image: halved recursively until each tile and all that it needs fits into memory.

A tile needs the Gaussians that reach its pixels, and those that cross the same rays: they shade it. On flat ground
these rays are those of the tile; what stands h above it is seen, at the grazing angle ψ, h·tan ψ nearer to the radar
than the ground below it (layover), and shades h/tan ψ of the ground behind it. No height is asked for: a ray's place
(x_r, y_r) on the computation plane holds all that shades what is on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.tiles.reach import NOWHERE, Reach, Window

_GAUSSIAN, _PARAMETER, _RAY, _PIXEL = 430, 4, 20, 24  # bytes, in the arrays of the engine and in ours
_WHOLE_GIB = 2.0  # for images that are rendered at once, without tiles
_RESPONSE_END = 6.0  # standard deviations, as in csrc/ground.h
_SMALLEST = 16  # pixels on a side: a smaller tile needs hardly less

LARGEST = 1024
"""Pixels on a side of a tile at most."""


def memory_bytes(gaussians: int, parameters: int, rays: float, pixels: int) -> float:
    """What rendering one view takes beyond the scene itself; `parameters` of each Gaussian's scattering."""
    return (_GAUSSIAN + _PARAMETER * parameters) * gaussians + _RAY * rays + _PIXEL * pixels


def at_once(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> int:
    """How many of the views `render` takes at once in little memory; 0: not even one, which is for `render_tiled`."""
    means, widest = gaussians.means.detach(), float(gaussians.scales.detach().max())
    low, high = (means.amin(0).cpu().numpy(), means.amax(0).cpu().numpy())
    reach = widest * math.sqrt(2 * math.log(MAX_OPTICAL_DEPTH / MIN_RAY_DEPTH))
    spans = [abs(view.look.frame[:2]) @ (high - low) + 2 * reach for view in views]
    most = max(map(math.prod, spans), default=0.0) / rays.cell_area
    parameters = gaussians.scattering.parameters.shape[1]
    each = memory_bytes(len(gaussians), parameters, most, grid.rows * grid.columns)
    return min(len(views), int(_WHOLE_GIB * 2**30 / each))


@dataclass(frozen=True)
class Tile:
    """A part of an image, and what it needs."""

    rows: slice
    columns: slice
    """Its pixels."""
    grid: ImageGrid
    """The same as a grid."""
    gaussians: Int64[Tensor, " k"]
    """Indices of those that reach it, or shade one that does."""


@dataclass(frozen=True)
class Plan:
    """The division of an image into tiles."""

    reach: Reach
    view: View
    grid: ImageGrid
    rays: RayGrid
    ground: Ground | None
    parameters: int
    budget_bytes: float

    def tiles(self) -> Iterator[Tile]:
        """The tiles: strips of columns, each from near range to far."""
        count = self.reach.on_rays.low.shape[1]
        everything = torch.arange(count, device=self.reach.on_rays.low.device)
        for first in range(0, self.grid.columns, LARGEST):
            columns = slice(first, min(first + LARGEST, self.grid.columns))
            yield from self._halves(slice(0, self.grid.rows), columns, self.reach, everything)

    def _halves(self, rows: slice, columns: slice, reach: Reach, gaussians: Int64[Tensor, " n"]) -> Iterator[Tile]:
        """The tiles of a part of the image, which these Gaussians with this reach make."""
        grid = self.grid.part(rows, columns)
        chosen = reach.on_rays.overlapping(self._rays_of(grid, reach))
        reach, gaussians = reach.some(chosen), gaussians[chosen]
        rays = reach.on_rays.window.area / self.rays.cell_area
        needed = memory_bytes(len(gaussians), self.parameters, rays, grid.rows * grid.columns)
        if needed <= self.budget_bytes and max(grid.rows, grid.columns) <= LARGEST:
            yield Tile(rows, columns, grid, gaussians)
            return
        if max(grid.rows, grid.columns) <= _SMALLEST:
            raise SarsplatError(
                f"{grid.rows} × {grid.columns} pixels alone need {len(gaussians)} Gaussians on {rays:.3g} rays, "
                f"{needed / 2**30:.3g} GiB, and tiles may take {self.budget_bytes / 2**30:.3g}; remove the widest "
                "Gaussians, use coarser rays, or allow more memory_gib"
            )
        for half in _halved(rows, columns):
            yield from self._halves(*half, reach, gaussians)

    def _rays_of(self, grid: ImageGrid, reach: Reach) -> Window:
        """Where the rays are that cross what reaches the pixels, or end on the ground that they show."""
        left, right, far, near = grid.extent_m
        reaching = reach.in_image.overlapping(Window((left, near), (right, far)))
        window = reach.on_rays.of(reaching).window
        return window.joined(NOWHERE if self.ground is None else self._rays_to_ground(grid, *self.ground.span_m))

    def _rays_to_ground(self, grid: ImageGrid, lowest_m: float, highest_m: float) -> Window:
        left, right, far, near = grid.extent_m
        azimuth, slant_range = (_RESPONSE_END * math.sqrt(variance) for variance in grid.response_variance_m2)
        x, y = self.view.look.rays_to_ground(
            (left - azimuth, right + azimuth), (near - slant_range, far + slant_range), (lowest_m, highest_m)
        )
        return Window((x[0], y[0]), (x[1], y[1]))


def _halved(rows: slice, columns: slice) -> list[tuple[slice, slice]]:
    if rows.stop - rows.start >= columns.stop - columns.start:
        middle = (rows.start + rows.stop) // 2
        return [(slice(rows.start, middle), columns), (slice(middle, rows.stop), columns)]
    middle = (columns.start + columns.stop) // 2
    return [(rows, slice(columns.start, middle)), (rows, slice(middle, columns.stop))]
