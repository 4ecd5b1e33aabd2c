"""First returns of many views at once, on the device of the Gaussians: nothing but sizes comes back to the CPU.

The same as `points.py` finds on the CPU, view by view, where points that are given up early take no more time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer import RayMap, render
from sarsplat.surface import cells
from sarsplat.tiles import at_once

_AT_ONCE = 1 << 22
"""Rays whose returns are calculated at once, and pairs of a point and a view that are compared at once."""


def some_at_once(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> Iterator[list[View]]:
    """The views, in their order: as many at a time as a GPU's memory takes; on the CPU, whose caches are small, one."""
    most = 1
    if len(gaussians) and not cells.on_cpu(gaussians.means):
        most = max(1, at_once(gaussians, views, grid, rays))
    return (list(views[k : k + most]) for k in range(0, len(views), most))


@dataclass(frozen=True)
class FirstReturns:
    """First returns of the rays of V views."""

    maps: Sequence[RayMap]
    range_m: Float[Tensor, " r"]
    """Of all rays, view by view; infinite where a ray meets nothing."""
    frames: Float64[Tensor, "v 3 3"]
    """R_r."""
    spacing_m: tuple[float, float]

    @classmethod
    def of(
        cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid, optical_depth: float
    ) -> Self:
        """Trace the rays, some views at a time."""
        maps: list[RayMap] = []
        pixel = replace(grid, rows=1, columns=1)  # images would take their time
        for some in some_at_once(gaussians, views, pixel, rays):
            black = gaussians.means.new_zeros(len(some), len(gaussians), 1)
            traced = render(gaussians, some, pixel, rays=rays, first_return_depth=optical_depth, amplitudes=black)
            maps += traced.ray_maps or ()
        ranges = torch.cat([each.first_return.flatten() for each in maps]).nan_to_num(math.inf, posinf=math.inf)
        frames = torch.from_numpy(np.stack([view.look.frame for view in views])).to(ranges.device)
        return cls(maps, ranges, frames, rays.spacing_m)

    @property
    def _sizes(self) -> list[int]:
        """Rays of each view."""
        return [each.first_return.numel() for each in self.maps]

    def points(self, terrain: Terrain | None, lowest_m: float) -> Iterator[Float64[Tensor, "p 3"]]:
        """The returns of each view in the world frame, m, that lie so high above the terrain."""
        sizes, rays, block = self._sizes, 0, list[int]()
        ranges = self.range_m.split(sizes)
        for view, size in enumerate(sizes):
            if block and rays + size > _AT_ONCE:
                yield from self._points_of(block, ranges, terrain, lowest_m)
                block, rays = [], 0
            block, rays = [*block, view], rays + size
        yield from self._points_of(block, ranges, terrain, lowest_m)

    def _points_of(
        self, views: Sequence[int], ranges: Sequence[Tensor], terrain: Terrain | None, lowest_m: float
    ) -> Sequence[Float64[Tensor, "p 3"]]:
        placed = [self._placed(view, ranges[view]) for view in views]
        points, finite = torch.cat(placed), torch.cat([ranges[view] for view in views]).isfinite()
        kept = finite & (_heights(points, terrain) >= lowest_m)
        ends = torch.from_numpy(np.cumsum([len(each) for each in placed])).to(kept.device)
        upto = torch.cat([kept.new_zeros(1, dtype=torch.int64), kept.cumsum(0)])[ends].tolist()
        return points[kept].split(np.diff([0, *upto]).tolist())

    def _placed(self, view: int, ranges: Float[Tensor, " r"]) -> Float64[Tensor, "r 3"]:
        """Where the rays of a view return, world frame, m; somewhere if they do not."""
        origin, spacing = np.array(self.maps[view].origin), np.array(self.spacing_m)
        rows, columns = self.maps[view].first_return.shape
        # rounded as on the CPU: voxels and rays may have edges in common
        x, y = ((origin - spacing)[k] + np.arange(1, n + 1) * spacing[k] for k, n in ((0, columns), (1, rows)))
        local = ranges.new_empty(rows, columns, 3, dtype=torch.float64)
        local[..., 0], local[..., 1] = torch.from_numpy(x).to(local), torch.from_numpy(y).to(local)[:, None]
        local[..., 2] = ranges.nan_to_num(posinf=0.0).view(rows, columns)
        return local.view(-1, 3) @ self.frames[view]

    def confirmed(
        self, points: Float64[Tensor, "p 3"], behind_m: float, seen_through: float, seen_by: int
    ) -> Bool[Tensor, " p"]:
        """Which points at most that share of the views look through, by more than `behind_m`, and so many see."""
        counts = torch.zeros(2, len(points), dtype=torch.int64, device=points.device)
        sizes, new = self._sizes, partial(torch.tensor, device=points.device)
        shapes = new([each.first_return.shape for each in self.maps])
        firsts = new(np.cumsum([0, *sizes[:-1]]))
        origins = new([each.origin for each in self.maps], dtype=torch.float64)
        spacing = new(self.spacing_m, dtype=torch.float64)
        each = max(1, _AT_ONCE // max(1, len(points)))
        for k in range(0, len(sizes), each):
            some = slice(k, k + each)
            local = (points @ self.frames[some].flatten(0, 1).T).view(len(points), -1, 3)
            place = ((local[..., :2] - origins[some]) / spacing).round()
            (column, row), (rows, columns) = place.unbind(-1), shapes[some].unbind(1)
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            ray = (firsts[some] + row * columns + column).where(inside, 0).long()
            beyond = self.range_m[ray].double().where(inside, math.inf) - local[..., 2]
            counts[0] += (beyond > behind_m).sum(1)
            counts[1] += (beyond.abs() <= behind_m).sum(1)
        return (counts[0] <= seen_through * len(sizes)) & (counts[1] >= seen_by)


def _heights(points: Float64[Tensor, "p 3"], terrain: Terrain | None) -> Float64[Tensor, " p"]:
    """How far points lie above the terrain, or above z = 0, m: `heights_of` on any device."""
    if terrain is None:
        return points[:, 2]
    table = torch.from_numpy(terrain.heights_m).to(points.device)
    (ny, nx), before, share = table.shape, [], []
    for at, half, pitch, count in zip(points.T, terrain.half_m, terrain.pitch_m, (nx, ny)):
        place = ((at + half) / pitch).clamp(0, count - 1)
        before.append(place.long().clamp(max=count - 2))
        share.append(place - before[-1])
    corner, (right, down) = before[1] * nx + before[0], share
    upper, lower = (
        table.flatten()[corner + step] * (1 - right) + table.flatten()[corner + step + 1] * right for step in (0, nx)
    )
    return points[:, 2] - (upper * (1 - down) + lower * down)
