"""Plan of tiles: an image is halved recursively until each tile with its Gaussians fits into memory.

A tile needs the Gaussians that reach its pixels, and those that cross the same rays, which shade it. On flat ground
these are the tile's rays; at height h and grazing angle ψ, objects appear h·tan ψ nearer to the radar (layover), and
shade h/tan ψ of the ground behind them. Heights need not be known: all Gaussians that shade each other share a place
(x_r, y_r) on the computation plane.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians, Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.tiles.halo import Halos, Window

_GAUSSIAN, _PARAMETER, _RAY, _PIXEL = 430, 4, 20, 24  # bytes of all arrays, each
_WHOLE_GIB = 2.0  # memory of a batch of views without tiles
_RESPONSE_END = 6.0  # standard deviations, as in csrc/ground.h
_SMALLEST = 16  # minimum side of a tile, pixels: a smaller one needs hardly less memory

LARGEST = 1024
"""Maximum side of a tile, pixels."""


def memory_bytes(gaussians: int, parameters: int, rays: float, pixels: int) -> float:
    """Memory to render one view, without the scene; a Gaussian has `parameters` numbers of scattering."""
    return (_GAUSSIAN + _PARAMETER * parameters) * gaussians + _RAY * rays + _PIXEL * pixels


def at_once(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> int:
    """Number of views that `render` does at once within 2 GiB; 0 if a single one is too large (`render_tiled`)."""
    means, widest = gaussians.means.detach(), float(gaussians.scales.detach().max())
    low, high = (means.amin(0).cpu().numpy(), means.amax(0).cpu().numpy())
    reach = widest * math.sqrt(2 * math.log(MAX_OPTICAL_DEPTH / MIN_RAY_DEPTH))
    spans = [abs(view.look.frame[:2]) @ (high - low) + 2 * reach for view in views]
    most = max(map(math.prod, spans), default=0.0) / rays.cell_area
    parameters = gaussians.scattering.parameters.shape[1]
    of_view = memory_bytes(len(gaussians), parameters, most, grid.rows * grid.columns)
    return min(len(views), int(_WHOLE_GIB * 2**30 / of_view))


@dataclass(frozen=True)
class Tile:
    """Part of an image, with its Gaussians."""

    rows: slice
    columns: slice
    """Pixels of the image."""
    grid: ImageGrid
    """Grid of these pixels."""
    gaussians: Int64[Tensor, " k"]
    """Indices of the Gaussians that reach the tile, or shade one that does."""


@dataclass(frozen=True)
class Plan:
    """Division of an image into tiles."""

    halos: Halos
    view: View
    grid: ImageGrid
    rays: RayGrid
    ground: Ground | None
    parameters: int
    budget_bytes: float

    def tiles(self) -> Iterator[Tile]:
        """Tiles by strips of columns, each from near to far range."""
        count = self.halos.on_rays.low.shape[1]
        index = torch.arange(count, device=self.halos.on_rays.low.device)
        for first in range(0, self.grid.columns, LARGEST):
            columns = slice(first, min(first + LARGEST, self.grid.columns))
            yield from self._halves(slice(0, self.grid.rows), columns, self.halos, index)

    def _halves(self, rows: slice, columns: slice, halos: Halos, gaussians: Int64[Tensor, " n"]) -> Iterator[Tile]:
        """Tiles of a part of the image, whose Gaussians are among those given with their halos."""
        grid = self.grid.part(rows, columns)
        chosen = halos.on_rays.overlapping(self._rays_of(grid, halos))
        halos, gaussians = halos.of_rows(chosen), gaussians[chosen]
        rays = halos.on_rays.window.area / self.rays.cell_area
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
            yield from self._halves(*half, halos, gaussians)

    def _rays_of(self, grid: ImageGrid, halos: Halos) -> Window:
        """Window of the rays that cross Gaussians in these pixels, or end on their ground."""
        left, right, far, near = grid.extent_m
        inside = halos.in_image.overlapping(Window((left, near), (right, far)))
        window = halos.on_rays.of(inside).window
        if self.ground is None:
            return window
        azimuth, slant_range = (_RESPONSE_END * math.sqrt(variance) for variance in grid.response_variance_m2)
        across, along = (left - azimuth, right + azimuth), (near - slant_range, far + slant_range)
        x, y = self.view.look.rays_to_ground(across, along, self.ground.span_m)
        return window.joined(Window((x[0], y[0]), (x[1], y[1])))


def _halved(rows: slice, columns: slice) -> list[tuple[slice, slice]]:
    """Cut a part of an image across its longer side, into (rows, columns) of both halves."""
    if rows.stop - rows.start >= columns.stop - columns.start:
        middle = (rows.start + rows.stop) // 2
        return [(slice(rows.start, middle), columns), (slice(middle, rows.stop), columns)]
    middle = (columns.start + columns.stop) // 2
    return [(rows, slice(columns.start, middle)), (rows, slice(middle, columns.stop))]
