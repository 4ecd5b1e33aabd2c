"""How much of the ground rays reach, in pixels.

A ray's cell, δx wide and δy high, meets the plane in a patch δx wide and δy/tan θ long in slant range. Patches of
neighbouring rays touch, and the Gaussian response of the system has a closed integral over a patch: so the lit ground
is flat, whatever the grazing angle and however far apart rays are, and a shadow's edge is right to a ray's cell. Where
no ray was traced, there is nothing above the ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.engines import cpu, structs
from sarsplat.renderer.once import differentiable_once


@dataclass(frozen=True)
class RayEnds:
    """T_end of the rays of all views, row by row, one view after the other.

    Parameters
    ----------
    transmittance : Tensor [R]
        Of every ray.
    sizes : sequence of (rows, columns), one per view
        Of the views' lattices.
    origins : sequence of (x_r, y_r), one per view
        Where their first rays are, m.
    """

    transmittance: Float[Tensor, " rays"]
    sizes: Sequence[tuple[int, int]]
    origins: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Axis:
    """Places along an axis, m: centres of pixels, or the edges before cells."""

    first: float
    step: float
    count: int

    @property
    def mirror(self) -> Any:
        """For the engine."""
        return structs.Axis(self.first, self.step, self.count)

    def places(self, device: torch.device) -> Float64[Tensor, " {self.count}"]:
        """All of them."""
        return self.first + self.step * torch.arange(self.count, dtype=torch.float64, device=device)


_Patches = Sequence[tuple[Axis, Axis]]
"""Rows and columns of what the rays of each view make on the ground, along slant range and azimuth."""


def lit_ground(
    ends: RayEnds,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    height_m: float,
    shift: Float[Tensor, "v 2"] | None,
    *,
    plain: bool = False,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """Share of each pixel's ground that the radar sees, through the response; differentiable by T_end and shift."""
    (dx, dy), patches = rays.spacing_m, []
    for view, (rows, columns), (x, y) in zip(views, ends.sizes, ends.origins, strict=True):
        theta = math.radians(view.grazing_deg)
        near = ((y - dy / 2) * math.cos(theta) - height_m) / math.sin(theta)  # on the plane r = (y cos θ − z) / sin θ
        patches.append((Axis(near, dy / math.tan(theta), rows), Axis(x - dx / 2, dx, columns)))
    left = ends.transmittance
    if not plain and left.dtype == torch.float32 and left.device.type == "cpu":
        return _Engine.apply(left, shift, patches, grid)  # type: ignore[no-any-return]
    return plain_lit_ground(left, shift, patches, grid)


def plain_lit_ground(
    transmittance: Float[Tensor, " rays"], shift: Float[Tensor, "v 2"] | None, patches: _Patches, grid: ImageGrid
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """`lit_ground` in plain torch, for any device and floating dtype."""
    (rows, columns), (azimuth_std, range_std), images = pixel_axes(grid), stds(grid), []
    parts = transmittance.split([down.count * across.count for down, across in patches])
    for k, (part, (down, across)) in enumerate(zip(parts, patches, strict=True)):
        azimuth_shift, range_shift = (0.0, 0.0) if shift is None else shift[k]
        along_range = seen(rows, down, range_std, range_shift, part)
        along_azimuth = seen(columns, across, azimuth_std, azimuth_shift, part)
        images.append(1 - along_range @ (1 - part.view(down.count, across.count)) @ along_azimuth.T)
    return torch.stack(images)


def pixel_axes(grid: ImageGrid) -> tuple[Axis, Axis]:
    """Rows and columns."""
    return (
        Axis(float(grid.range_m[0]), grid.spacing_m[1], grid.rows),
        Axis(float(grid.azimuth_m[0]), grid.spacing_m[0], grid.columns),
    )


def stds(grid: ImageGrid) -> tuple[float, float]:
    """Of the response, m: azimuth, range."""
    azimuth, slant_range = grid.response_variance_m2
    return math.sqrt(azimuth), math.sqrt(slant_range)


def seen(pixels: Axis, cells: Axis, std: float, shift: Tensor | float, like: Tensor) -> Float[Tensor, "n k"]:
    """Integrals of the response of each pixel over each cell."""
    centres, edges = (axis.places(like.device) for axis in (pixels, replace(cells, count=cells.count + 1)))
    below = torch.erf(((centres[:, None] - edges).to(like) - shift) / (math.sqrt(2) * std)) / 2
    return below[:, :-1] - below[:, 1:]


class _Engine(torch.autograd.Function):
    """`plain_lit_ground` by the CPU engine, whose sums do not depend on the number of threads; differentiable once."""

    @staticmethod
    def forward(ctx: Any, transmittance: Tensor, shift: Tensor | None, patches: _Patches, grid: ImageGrid) -> Tensor:
        transmittance, shift = transmittance.contiguous(), None if shift is None else shift.contiguous()
        lit = transmittance.new_empty(len(patches), grid.rows, grid.columns)
        _run(transmittance, shift, patches, grid, lit=lit)
        ctx.save_for_backward(transmittance, shift)
        ctx.patches, ctx.grid = patches, grid
        return lit

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_lit: Tensor) -> tuple[Tensor | None, ...]:
        transmittance, shift = ctx.saved_tensors
        d_transmittance = torch.empty_like(transmittance)
        d_shift = torch.empty_like(shift) if ctx.needs_input_grad[1] else None
        results = {"d_lit": d_lit.contiguous(), "d_transmittance": d_transmittance, "d_shift": d_shift}
        _run(transmittance, shift, ctx.patches, ctx.grid, **results)
        return d_transmittance, d_shift, None, None


def _run(
    transmittance: Tensor, shift: Tensor | None, patches: _Patches, grid: ImageGrid, **results: Tensor | None
) -> None:
    mirrors = (structs.Patches * len(patches))(*(structs.Patches(down.mirror, over.mirror) for down, over in patches))
    call = structs.Ground(len(patches), *(axis.mirror for axis in pixel_axes(grid)), stds(grid), mirrors)
    for name, tensor in {"transmittance": transmittance, "shift": shift, **results}.items():
        setattr(call, name, None if tensor is None else tensor.data_ptr())
    cpu.Pass().lit_ground(call)
