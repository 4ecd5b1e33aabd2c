"""Share of the ground that rays reach, in pixels.

A ray's cell, δx wide and δy high, meets the plane in a patch δx wide and δy/tan θ long in slant range. Patches of
neighbouring rays touch, and the Gaussian response of the system has a closed integral over a patch: so the lit ground
is uniform at any grazing angle and ray spacing, and a shadow's edge is right to a ray's cell. Where no ray was traced,
the ground is lit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.engines.on_device import candidates
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.engines.passes import NewPass


@dataclass(frozen=True)
class Axis:
    """Equidistant places along an axis, m: centres of pixels, or lower edges of cells."""

    first: float
    step: float
    count: int

    @property
    def numbers(self) -> tuple[float, float, int]:
        """Arguments for the engine."""
        return self.first, self.step, self.count

    def places(self, device: torch.device) -> Float64[Tensor, " {self.count}"]:
        """Return all places, m."""
        return self.first + self.step * torch.arange(self.count, dtype=torch.float64, device=device)


_Patches = Sequence[tuple[Axis, Axis]]
"""Rows (slant range) and columns (azimuth) of the patches of each view's rays on the ground."""


def lit_ground(
    ends: RayEnds,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    height_m: float,
    shift: Float[Tensor, "v 2"] | None,
    new_pass: NewPass | None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """Return the lit share of each pixel's ground, through the response; differentiable by T_end and shift."""
    (every, chosen), (dx, dy), patches = candidates(views), rays.spacing_m, []
    for view, (rows, columns), (x, y) in zip(every, ends.sizes, ends.origins, strict=True):
        down = Axis(*view.look.rows_on_ground(y - dy / 2, dy, height_m), rows)
        patches.append((down, Axis(x - dx / 2, dx, columns)))
    return LitGround(patches, grid, chosen).on(new_pass, ends.transmittance, shift)


class LitGround(Operation):
    """Operation of `lit_ground`, given the rays' patches; on engines, sums do not depend on threads.

    For `ChosenViews` there are patches of all candidates, and each view has equally many rays.
    """

    operation = "lit_ground"
    names = ("transmittance", "shift")
    optional = ("shift",)

    def __init__(self, patches: _Patches, grid: ImageGrid, chosen: Int64[Tensor, " v"] | None = None) -> None:
        self.patches, self.grid, self.chosen = patches, grid, chosen

    def plain(
        self, transmittance: Float[Tensor, " rays"], shift: Float[Tensor, "v 2"] | None
    ) -> Float[Tensor, "v {self.grid.rows} {self.grid.columns}"]:
        (rows, columns), (azimuth_std, range_std), images = pixel_axes(self.grid), stds(self.grid), []
        parts = transmittance.split([down.count * across.count for down, across in self.patches])
        for k, (part, (down, across)) in enumerate(zip(parts, self.patches, strict=True)):
            azimuth_shift, range_shift = (0.0, 0.0) if shift is None else shift[k]
            along_range = response_integrals(rows, down, range_std, range_shift, part)
            along_azimuth = response_integrals(columns, across, azimuth_std, azimuth_shift, part)
            images.append(1 - along_range @ (1 - part.view(down.count, across.count)) @ along_azimuth.T)
        return torch.stack(images)

    def numbers(self, transmittance: Tensor, shift: Tensor | None) -> dict[str, Any]:
        sizes = [down.count * across.count for down, across in self.patches]
        of_rays, firsts = ray_numbers(self.grid, self._views, sizes, len(transmittance), self.chosen)
        return {
            **of_rays,
            "patches": [
                {"rows": down.numbers, "columns": across.numbers, "first": first}
                for (down, across), first in zip(self.patches, firsts, strict=True)
            ],
        }

    def outputs(self, transmittance: Tensor, shift: Tensor | None) -> dict[str, Tensor]:
        return {"lit": transmittance.new_empty(self._views, self.grid.rows, self.grid.columns)}

    @property
    def _views(self) -> int:
        return len(self.patches) if self.chosen is None else len(self.chosen)


def ray_numbers(
    grid: ImageGrid, views: int, sizes: Sequence[int], rays: int, chosen: Int64[Tensor, " v"] | None
) -> tuple[dict[str, Any], Sequence[int]]:
    """Return the engine's numbers that ground and terrain share, and the first of the rays of every view.

    `sizes` are numbers of rays of each view, or candidate; `rays` that of all, of `ChosenViews` a `pitch` for each.
    """
    (down, across), in_order = pixel_axes(grid), chosen is None
    shared = {"views": views, "rows": down.numbers, "columns": across.numbers, "std": stds(grid), "chosen": chosen}
    shared |= {"of_views": len(sizes), "pitch": 0 if in_order else rays // views}
    return shared, [*accumulate(sizes[:-1], initial=0)] if in_order else [0] * len(sizes)


def pixel_axes(grid: ImageGrid) -> tuple[Axis, Axis]:
    """Return rows and columns of an image."""
    return (
        Axis(float(grid.range_m[0]), grid.spacing_m[1], grid.rows),
        Axis(float(grid.azimuth_m[0]), grid.spacing_m[0], grid.columns),
    )


def stds(grid: ImageGrid) -> tuple[float, float]:
    """Return standard deviations of the response along azimuth and range, m."""
    azimuth, slant_range = grid.response_variance_m2
    return math.sqrt(azimuth), math.sqrt(slant_range)


def response_integrals(
    pixels: Axis, cells: Axis, std: float, shift: Tensor | float, like: Tensor
) -> Float[Tensor, "n k"]:
    """Integrate the response of each pixel over each cell."""
    centres, edges = (axis.places(like.device) for axis in (pixels, replace(cells, count=cells.count + 1)))
    below = torch.erf(((centres[:, None] - edges).to(like) - shift) / (math.sqrt(2) * std)) / 2
    return below[:, :-1] - below[:, 1:]
