"""Level ground between a transmitter and a receiver apart.

Each place of it is lit over √(T_t·T_r) of what is left of the rays through it, along either way. Where rays of one
radar halfway would end, that is looked up among the rays of both ways, so that what they make on the ground is imaged
as that radar's is. Its slant ranges are longer by 1/cos(β/2), and the ground has √((n·u_t)(n·u_r)) in place of n·u of
its area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.both_ways import both_ways
from sarsplat.renderer.echoes.echo import Sighting, ends_of
from sarsplat.renderer.echoes.ground import GroundEcho
from sarsplat.renderer.places import at_places
from sarsplat.renderer.rendering import RayMap

_MARGIN = 1.0
"""Cells around the rays that were traced, from where on everything is free."""

_MAX_RAYS = 1 << 26
"""Of one view, as many as take 2 GB on the way back."""


@dataclass(frozen=True)
class _Rays:
    """How rays of a view meet a level plane: (x_r, y_r) = turn · (x, y) + foot, m."""

    turn: Float64[np.ndarray, "2 2"]
    foot: Float64[np.ndarray, " 2"]

    @classmethod
    def of(cls, view: View, height_m: float) -> _Rays:
        frame = view.look.frame
        return cls(frame[:2, :2], height_m * frame[:2, 2])

    def to(self, other: _Rays) -> tuple[Float64[np.ndarray, "2 2"], Float64[np.ndarray, " 2"]]:
        """Where rays that meet the plane in the same place are in another view: a matrix, and what is added."""
        matrix = other.turn @ np.linalg.inv(self.turn)
        return matrix, other.foot - matrix @ self.foot


def ground_two_ways(echo: GroundEcho, maps: Sequence[RayMap], sighting: Sighting) -> Float[Tensor, "v rows columns"]:
    """β⁰ of a plane in all views, given what is left of rays along their ways in, and then along their ways out."""
    s, returned, height_m = sighting, [], echo.ground.height_m
    assert not isinstance(height_m, Terrain)  # refused
    for k, view in enumerate(s.views):
        look, one = view.look, replace(view, apart_deg=0.0, apart_towards_deg=0.0)
        met = _met_halfway(height_m, view, one, (maps[k], maps[k + len(s.views)]), s.rays)
        longer = _in_range(s.grid, 1 / look.shortening)
        moved = None if s.shift is None else s.shift[k : k + 1] * s.shift.new_tensor([1.0, 1 / look.shortening])
        of_one = replace(s, views=[one], grid=longer, shift=moved, lit_area=s.lit_area[k : k + 1], ends=ends_of([met]))
        seen = echo.returned(echo.seen(of_one), [one], longer, moved)
        u, u_t, u_r = (float(way[2]) for way in (look.facing, look.way_in, look.way_out))
        returned.append(seen * (math.sqrt(u_t * u_r) / (u * look.shortening)))
    return torch.cat(returned)


def _in_range(grid: ImageGrid, factor: float) -> ImageGrid:
    """A grid whose slant ranges are so many times as long."""
    spacing, resolution, center = (
        (azimuth, slant_range * factor) for azimuth, slant_range in (grid.spacing_m, grid.resolution_m, grid.center_m)
    )
    return replace(grid, spacing_m=spacing, resolution_m=resolution, center_m=center)


def _met_halfway(height_m: float, view: View, one: View, traced: tuple[RayMap, RayMap], rays: RayGrid) -> RayMap:
    """What is left of both ways, where rays of one radar halfway meet the plane."""
    own, step = _Rays.of(one, height_m), np.array(rays.spacing_m)
    legs = [_Rays.of(leg, height_m) for leg in (view.legs[0], view.legs[-1])]
    corners = [
        corner for leg, ray_map in zip(legs, traced, strict=True) for corner in _corners(leg, own, ray_map, step)
    ]
    if not corners:
        return replace(traced[0], first_return=torch.full_like(traced[0].transmittance, math.nan))
    low = np.floor(np.min(corners, axis=0) / step).astype(int)
    columns, rows = (np.ceil(np.max(corners, axis=0) / step).astype(int) - low).tolist()
    if columns * rows > _MAX_RAYS:
        raise SarsplatError(
            f"{view!r} needs {columns * rows:.2g} rays on the ground, where {_MAX_RAYS:.2g} is the limit; use "
            "coarser rays, or remove distant Gaussians and views at low grazing angles"
        )
    origin = (low + 0.5) * step
    like = traced[0].transmittance
    x = torch.from_numpy(origin[0] + step[0] * np.arange(columns)).to(like.device)
    y = torch.from_numpy(origin[1] + step[1] * np.arange(rows)).to(like.device)[:, None]
    there, back = (_left(ray_map, own.to(leg), x, y, step) for leg, ray_map in zip(legs, traced, strict=True))
    met = both_ways(there, back)
    return RayMap(met, torch.full_like(met, math.nan), (float(origin[0]), float(origin[1])))


def _corners(
    leg: _Rays, own: _Rays, ray_map: RayMap, step: Float64[np.ndarray, " 2"]
) -> list[Float64[np.ndarray, " 2"]]:
    """Around the rays of a way that were traced, in the lattice of rays halfway."""
    if not ray_map.transmittance.numel():
        return []
    matrix, added = leg.to(own)
    rows, columns = ray_map.transmittance.shape
    ends = np.array(ray_map.origin) + step * np.array(
        [[-_MARGIN, -_MARGIN], [columns - 1 + _MARGIN, rows - 1 + _MARGIN]]
    )
    return [matrix @ (x, y) + added for x in ends[:, 0] for y in ends[:, 1]]


def _left(
    ray_map: RayMap,
    onto: tuple[Float64[np.ndarray, "2 2"], Float64[np.ndarray, " 2"]],
    x: Float64[Tensor, " columns"],
    y: Float64[Tensor, "rows 1"],
    step: Float64[np.ndarray, " 2"],
) -> Float[Tensor, "rows columns"]:
    """What is left of a way's rays at places of the lattice halfway: linear between them, and 1 beyond them."""
    free = torch.nn.functional.pad(ray_map.transmittance, (1, 1, 1, 1), value=1.0)
    matrix, added = onto
    places = (
        (a * x + b * y + c - first) / width - (count - 3) / 2
        for (a, b), c, first, width, count in zip(
            matrix.tolist(), added.tolist(), ray_map.origin, step.tolist(), reversed(free.shape), strict=True
        )
    )
    across, along = (place.to(free.dtype) for place in places)
    return at_places(free, across, along, 1.0)
