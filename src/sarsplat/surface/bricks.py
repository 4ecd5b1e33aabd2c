"""Extraction in parts: bricks of voxels, the rays of each view that cross one, and the Gaussians that these rays meet.

Rays are those of one lattice, a Gaussian has the same footprint on it for every brick, and all that a ray of a brick
meets is there, however far in front: so what a brick's rays return does not depend on the bricks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import RayGrid, View
from sarsplat.renderer import RayMap
from sarsplat.renderer.constants import CELL_WIDENING, MIN_RAY_DEPTH
from sarsplat.tiles.reach import rows_of

_CUBES = 48  # along the longest side of the scene, by which Gaussians are looked for
_SMALLEST = 32  # steps of rays along the sides of a brick: in smaller ones, rays at the rim outnumber the others
_CORNERS = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T


@dataclass(frozen=True)
class Window:
    """Rays of a view's lattice: column k and row l are at ((k + ½)·δx, (l + ½)·δy)."""

    column: int
    row: int
    """The first ones."""
    columns: int
    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    @classmethod
    def around(cls, corners: Float64[np.ndarray, "c 2"], rays: RayGrid) -> Window:
        """The rays around some places on the computation plane, m, and one more on each side."""
        low, high = (corners / rays.spacing_m - 0.5).min(0), (corners / rays.spacing_m - 0.5).max(0)
        (column, row), (last, end) = np.floor(low).astype(int) - 1, np.ceil(high).astype(int) + 1
        return cls(int(column), int(row), int(last - column) + 1, int(end - row) + 1)

    @classmethod
    def of(cls, ray_map: RayMap, rays: RayGrid) -> Window:
        """Where the rays of a map are."""
        column, row = (round(first / step - 0.5) for first, step in zip(ray_map.origin, rays.spacing_m, strict=True))
        rows, columns = ray_map.first_return.shape
        return cls(column, row, columns, rows)

    def cut(self, ray_map: RayMap, rays: RayGrid) -> Float[Tensor, "rows columns"]:
        """The ranges of first returns on these rays, m; infinite where a ray meets nothing."""
        found, there = ray_map.first_return.nan_to_num(math.inf, posinf=math.inf), Window.of(ray_map, rays)
        if there == self:
            return found
        ranges = found.new_full(self.shape, math.inf)
        x, y = there.column - self.column, there.row - self.row
        inside = (slice(max(y, 0), max(0, y + there.rows)), slice(max(x, 0), max(0, x + there.columns)))
        part = found[max(-y, 0) : max(0, self.rows - y), max(-x, 0) : max(0, self.columns - x)]
        ranges[inside] = part
        return ranges


@dataclass(frozen=True)
class Brick:
    """A box of voxels: those from `first` on, before `end`."""

    first: tuple[int, int, int]
    end: tuple[int, int, int]
    side_m: float
    """Of a voxel."""

    def window(self, view: View, rays: RayGrid, beyond_m: float = 0.0) -> Window:
        """The rays on which what lies in it is seen, or so far beyond it."""
        corners = np.where(_CORNERS, self.end, self.first) * self.side_m @ view.look.frame[:2].T
        return Window.around(np.concatenate([corners - beyond_m, corners + beyond_m]), rays)

    def holds(self, points: Float64[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Which points lie in its voxels."""
        cells = (points / self.side_m).floor()
        first, end = (cells.new_tensor(corner) for corner in (self.first, self.end))
        return ((cells >= first) & (cells < end)).all(1)

    def halves(self) -> tuple[Brick, Brick]:
        """Cut across its longest side."""
        axis = int(np.argmax(np.subtract(self.end, self.first)))
        middle = (self.first[axis] + self.end[axis]) // 2
        (x, y, z), (i, j, k) = (
            (middle if along == axis else corner for along, corner in enumerate(corners))
            for corners in (self.end, self.first)
        )
        return replace(self, end=(x, y, z)), replace(self, first=(i, j, k))


@dataclass(frozen=True)
class _Cubes:
    """Places sorted by cubes of space."""

    order: Int64[np.ndarray, " n"]
    """The places, those of a cube one after the other."""
    starts: Int64[np.ndarray, " c"]
    """Where those of each cube begin."""
    middles: Float64[np.ndarray, "c 3"]
    halves: Float64[np.ndarray, "c 3"]
    """Of boxes around what the places of a cube reach, m."""

    @classmethod
    def of(cls, places: Float64[np.ndarray, "n 3"], reach: Float64[np.ndarray, "n 1"]) -> _Cubes:
        extent = places - places.min(0)
        cubes = np.floor(extent * (_CUBES / max(float(extent.max()), 1e-6))).astype(np.int64)  # the last is on the edge
        number = (cubes[:, 0] * (_CUBES + 1) + cubes[:, 1]) * (_CUBES + 1) + cubes[:, 2]
        order = np.argsort(number, kind="stable")
        starts = np.unique(number[order], return_index=True)[1]
        low, high = (
            np.minimum.reduceat((places - reach)[order], starts),
            np.maximum.reduceat((places + reach)[order], starts),
        )
        return cls(order, starts, (low + high) / 2, (high - low) / 2)


class Scene:
    """Gaussians, sorted by cubes of space: which of them the rays of a window meet."""

    def __init__(self, gaussians: Gaussians, rays: RayGrid) -> None:
        self.gaussians = gaussians
        self._step_m = max(rays.spacing_m)

    @cached_property
    def _means(self) -> Float64[np.ndarray, "n 3"]:
        return self.gaussians.means.double().cpu().numpy()

    @cached_property
    def _reach(self) -> Float64[np.ndarray, " n"]:
        """Farthest ray that a Gaussian touches, m; and a ray more, for what float32 rounds."""
        g = self.gaussians
        depth, widest = (each.double().cpu().numpy() for each in (g.optical_depth, g.scales.amax(1)))
        deviations = np.sqrt(2 * np.log(np.maximum(depth / MIN_RAY_DEPTH, 1)))
        return deviations * np.sqrt(widest**2 + CELL_WIDENING * self._step_m**2) + self._step_m

    @cached_property
    def _cubes(self) -> _Cubes:
        return _Cubes.of(self._means, self._reach[:, None])

    def bricks(self, views: Sequence[View], rays: RayGrid, side_m: float, most_rays: float) -> Iterator[Brick]:
        """Boxes of voxels of a side, m, for which the views need so many rays at most; those with Gaussians."""
        low, high = (self._means - self._reach[:, None]).min(0), (self._means + self._reach[:, None]).max(0)
        first, end = np.floor(low / side_m).astype(int), np.floor(high / side_m).astype(int) + 1
        (i, j, k), (x, y, z) = first.tolist(), end.tolist()
        whole = Brick((i, j, k), (x, y, z), side_m)
        yield from self._halved(whole, np.arange(len(self._means)), views, rays, most_rays)

    def _halved(
        self, brick: Brick, some: Int64[np.ndarray, " k"], views: Sequence[View], rays: RayGrid, most_rays: float
    ) -> Iterator[Brick]:
        low, high = np.multiply(brick.first, brick.side_m), np.multiply(brick.end, brick.side_m)
        means, reach = self._means[some], self._reach[some, None]
        some = some[((means + reach >= low) & (means - reach <= high)).all(1)]
        if not len(some):
            return
        windows = (brick.window(view, rays) for view in views)
        if sum(window.rows * window.columns for window in windows) <= most_rays or max(high - low) <= max(
            _SMALLEST * self._step_m, brick.side_m
        ):
            yield brick
            return
        for half in brick.halves():
            yield from self._halved(half, some, views, rays, most_rays)

    def met_by(self, window: Window, view: View, rays: RayGrid) -> tuple[Int64[Tensor, " k"], Gaussians]:
        """The Gaussians that rays of a window may meet: their indices, in order, and themselves."""
        axes, spacing = view.look.frame[:2], np.array(rays.spacing_m)
        low = (np.array([window.column, window.row]) + 0.5) * spacing
        high = low + (np.array([window.columns, window.rows]) - 1) * spacing
        cubes = self._cubes
        middles, halves = cubes.middles @ axes.T, cubes.halves @ abs(axes).T
        near = np.flatnonzero(((middles + halves >= low) & (middles - halves <= high)).all(1))
        ends = np.append(cubes.starts[1:], len(cubes.order))
        index = np.sort(np.concatenate([cubes.order[:0], *(cubes.order[cubes.starts[k] : ends[k]] for k in near)]))
        places, reach = self._means[index] @ axes.T, self._reach[index, None]
        index = index[((places + reach >= low) & (places - reach <= high)).all(1)]
        chosen = torch.from_numpy(index).to(self.gaussians.means.device)
        return chosen, rows_of(self.gaussians, chosen)

    def widest_m(self, some: Int64[Tensor, " k"]) -> float:
        """How far from their centres these Gaussians touch rays at most, m."""
        return float(self._reach[some.cpu().numpy()].max(initial=0))


def ray_count(gaussians: Gaussians, views: Sequence[View], rays: RayGrid) -> float:
    """About how many rays the views have, as far as there are Gaussians."""
    means, reach = gaussians.means.double().cpu().numpy(), 3 * float(gaussians.scales.max()) if len(gaussians) else 0
    total = 0.0
    for view in views if len(means) else ():
        sides = np.ptp(view.look.frame[:2] @ means.T, axis=1) + 2 * reach
        total += math.prod(sides / rays.spacing_m)
    return total
