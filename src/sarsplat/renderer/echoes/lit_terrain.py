"""β⁰ of terrain where rays end on it.

A ray's cell, δx wide and δy high across the line of sight, returns γ⁰·T_end·δx·δy from between the slant ranges where
its lower and its upper edge meet the terrain, spread evenly: β⁰ is γ⁰·δy over the length of that interval, γ⁰·tan θ on
a plane.
Intervals of neighbouring rays touch, but at summits, and overlap in layover. The Gaussian response of the system has a
closed integral over an interval, so nothing depends on the ray spacing. Where no ray was traced, T_end is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_ground import Axis, pixel_axes, ray_numbers, response_integrals, stds
from sarsplat.renderer.echoes.terrain_cells import Cells, cells_of
from sarsplat.renderer.engines.on_device import candidates
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.point_queries import at_places

_SHORT = {torch.float32: 0.25, torch.float64: 0.02}
"""Lengths, in standard deviations of the response, below which a difference of error functions has too few digits, and
two-point quadrature is as good."""

_MAX_SAVED = 1 << 22  # weights of plain torch above which they are recomputed in the backward pass instead of saved


@dataclass(frozen=True)
class _Patches:
    """Patches of the rays of one view on terrain."""

    cells: Cells
    across: Axis
    """Azimuths of the cells."""
    traced: tuple[tuple[int, int], tuple[int, int]]
    """(Row, column) of the first ray with known T_end among the cells, and size of the rays' lattice, maybe beyond."""
    along_x: tuple[float, ...]
    along_y: tuple[float, ...]
    """Coefficients of a cell centre's x and y, m: constant, and gradients with column, row and slant range."""

    @classmethod
    def of(
        cls, cells: Cells, view: View, rays: RayGrid, size: tuple[int, int], origin: tuple[float, float]
    ) -> "_Patches":
        """Place the cells of a view, whose traced rays have a lattice of `size` from `origin`, m (`RayEnds`)."""
        (dx, dy), frame = rays.spacing_m, view.look.frame
        x, y = ((first + 0.5) * step for first, step in zip(cells.first, rays.spacing_m))
        column, row = (
            round(at / step - 0.5) - first for at, step, first in zip(origin, rays.spacing_m, cells.first, strict=True)
        )
        along_x, along_y = (
            (float(a * x + b * y), float(a * dx), float(b * dy), float(r)) for a, b, r in frame[:, :2].T
        )
        across = Axis(cells.first[0] * dx, dx, cells.low_m.shape[1])
        return cls(cells, across, ((row, column), size), along_x, along_y)


def lit_terrain(
    ends: RayEnds,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    terrain: Terrain | float,
    gamma0: Float[Tensor, "v ny nx"],
    pitch_m: float,
    shift: Float[Tensor, "v 2"] | None,
    new_pass: NewPass | None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """Return β⁰ of terrain, or of the plane z = `terrain`; differentiable by T_end, γ⁰ and shift.

    `gamma0` is a table for each view, `pitch_m` apart along x and y, around the origin.
    """
    every, chosen = candidates(views)
    patches = [
        _Patches.of(cells, view, rays, size, origin)
        for cells, view, size, origin in zip(
            cells_of(terrain, views, grid, rays, shift), every, ends.sizes, ends.origins, strict=True
        )
    ]
    return LitTerrain(patches, pitch_m, grid, rays.spacing_m[1], chosen).on(new_pass, ends.transmittance, gamma0, shift)


class LitTerrain(Operation):
    """Operation of `lit_terrain`, given the rays' patches; on engines, sums do not depend on threads.

    For `ChosenViews` there are patches of all candidates, and each view has equally many rays. `ray_m` is the height δy
    of a ray's cell.
    """

    operation = "lit_terrain"
    names = ("transmittance", "gamma0", "shift")
    optional = ("shift",)

    def __init__(
        self,
        patches: Sequence[_Patches],
        pitch_m: float,
        grid: ImageGrid,
        ray_m: float,
        chosen: Int64[Tensor, " v"] | None = None,
    ) -> None:
        self.patches, self.pitch_m, self.grid, self.ray_m, self.chosen = patches, pitch_m, grid, ray_m, chosen

    def plain(
        self,
        transmittance: Float[Tensor, " rays"],
        gamma0: Float[Tensor, "v ny nx"],
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v {self.grid.rows} {self.grid.columns}"]:
        (rows, columns), (azimuth_std, range_std), images = pixel_axes(self.grid), stds(self.grid), []
        parts = transmittance.split([math.prod(patch.traced[1]) for patch in self.patches])
        saved = rows.count * sum(patch.cells.low_m.numel() for patch in self.patches) <= _MAX_SAVED
        for k, (patch, part) in enumerate(zip(self.patches, parts, strict=True)):
            azimuth_shift, range_shift = (0.0, 0.0) if shift is None else shift[k]
            low, high = (edge.to(part) for edge in (patch.cells.low_m, patch.cells.high_m))
            gamma0_at = _gamma0(patch, gamma0[k], self.pitch_m, (low + high) / 2)
            returned = self.ray_m * gamma0_at * _everywhere(patch, part)
            pixels = rows.places(part.device).to(part) - range_shift
            width = max(1, _MAX_SAVED // max(1, rows.count * len(low)))
            ranged = [
                _ranged(pixels, power, a, b, range_std)
                if saved
                else checkpoint(_ranged, pixels, power, a, b, range_std, use_reentrant=False)
                for power, a, b in zip(*(table.split(width, dim=1) for table in (returned, low, high)), strict=True)
            ]
            across = response_integrals(columns, patch.across, azimuth_std, azimuth_shift, part)
            images.append(torch.cat(ranged, dim=1) @ across.T)
        return torch.stack(images)

    def numbers(self, transmittance: Tensor, gamma0: Tensor, shift: Tensor | None) -> dict[str, Any]:
        sizes = [math.prod(patch.traced[1]) for patch in self.patches]
        of_rays, firsts = ray_numbers(self.grid, len(gamma0), sizes, len(transmittance), self.chosen)
        patches = [self._patch(patch, first, gamma0) for patch, first in zip(self.patches, firsts, strict=True)]
        return {**of_rays, "cell": self.ray_m, "places": tuple(gamma0.shape[1:]), "patches": patches}

    def _patch(self, patch: _Patches, first_ray: int, gamma0: Tensor) -> dict[str, Any]:
        """Return members of the engine's structure of patches; x and y are in steps of the table of γ⁰."""
        (first, traced), cells, pitch_m = patch.traced, patch.cells, self.pitch_m
        (low, high), (_, ny, nx) = cells.edges(gamma0.device), gamma0.shape
        return {
            **{"rows": len(cells.low_m), "across": patch.across.numbers, "low": low, "high": high},
            **{"traced_first": first, "traced": traced, "first": first_ray},
            **{
                name: (along[0] / pitch_m + (count - 1) / 2, *(slope / pitch_m for slope in along[1:]))
                for name, along, count in (("x", patch.along_x, nx), ("y", patch.along_y, ny))
            },
        }

    def outputs(self, transmittance: Tensor, gamma0: Tensor, shift: Tensor | None) -> dict[str, Tensor]:
        return {"lit": transmittance.new_empty(len(gamma0), self.grid.rows, self.grid.columns)}


def _everywhere(patch: _Patches, traced: Float[Tensor, " n"]) -> Float[Tensor, "rows columns"]:
    """Return T_end of all rays: 1 where none was traced."""
    everywhere, (first, size) = traced.new_ones(patch.cells.low_m.shape), patch.traced
    inside = [
        slice(max(at, 0), max(min(at + count, limit), 0))
        for at, count, limit in zip(first, size, everywhere.shape, strict=True)
    ]
    own = [slice(part.start - at, part.stop - at) for part, at in zip(inside, first)]
    if all(part.start < part.stop for part in inside):
        everywhere[inside[0], inside[1]] = traced.view(size)[own[0], own[1]]
    return everywhere


def _gamma0(
    patch: _Patches, table: Float[Tensor, "ny nx"], pitch_m: float, range_m: Float[Tensor, "rows columns"]
) -> Float[Tensor, "rows columns"]:
    """Return γ⁰ at the centres of cells."""
    if table.numel() == 1:
        return table.expand(range_m.shape)
    row, column = (
        torch.arange(count, dtype=torch.float64, device=range_m.device).to(range_m) for count in range_m.shape
    )
    x, y = (a + b * column[None] + c * row[:, None] + d * range_m for a, b, c, d in (patch.along_x, patch.along_y))
    return at_places(table, x, y, pitch_m)


def _ranged(
    pixels: Float[Tensor, " n"],
    returned: Float[Tensor, "rows c"],
    low: Float[Tensor, "rows c"],
    high: Float[Tensor, "rows c"],
    std: float,
) -> Float[Tensor, "n c"]:
    """Sum cells between these slant ranges, weighted with the mean of each pixel's response over them."""
    at, length = pixels[:, None, None], high - low
    short = length.abs() < _SHORT[pixels.dtype] * std
    below, above = (torch.erf((at - edge) / (math.sqrt(2) * std)) for edge in (low, high))
    long_mean = (below - above) / (2 * torch.where(short, torch.ones_like(length), length))
    points = (
        torch.exp(-0.5 * ((at - (low + share * length)) / std) ** 2) for share in (0.5 - 12**-0.5, 0.5 + 12**-0.5)
    )
    short_mean = sum(points) / (2 * math.sqrt(2 * math.pi) * std)
    return (torch.where(short, short_mean, long_mean) * returned).sum(1)
