"""Extraction by bricks of voxels: the rays of each view that cross a brick, and the Gaussians that these rays meet.

All bricks share one lattice of rays and Gaussians' footprints on it, and a brick gets every Gaussian that its rays
meet, however far in front: so the returns of rays do not depend on the division into bricks.
"""

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
from sarsplat.tiles.halo import rows_of

_CUBES = 48  # search cubes along the longest side of the scene
_SMALLEST = 32  # ray spacings along a brick's side, at least: in smaller ones, most rays are at the rim
_CORNERS = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T


@dataclass(frozen=True)
class Window:
    """Rays of a view's lattice: column k and row l are at ((k + ½)·δx, (l + ½)·δy)."""

    column: int
    row: int
    """First column and row."""
    columns: int
    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    @classmethod
    def around(cls, corners: Float64[np.ndarray, "c 2"], rays: RayGrid) -> "Window":
        """Rays around places on the computation plane, m, and one more on each side."""
        low, high = (corners / rays.spacing_m - 0.5).min(0), (corners / rays.spacing_m - 0.5).max(0)
        (column, row), (last, end) = np.floor(low).astype(int) - 1, np.ceil(high).astype(int) + 1
        return cls(int(column), int(row), int(last - column) + 1, int(end - row) + 1)

    @classmethod
    def of(cls, ray_map: RayMap, rays: RayGrid) -> "Window":
        """Window of a map's rays."""
        column, row = (round(first / step - 0.5) for first, step in zip(ray_map.origin, rays.spacing_m, strict=True))
        rows, columns = ray_map.first_return.shape
        return cls(column, row, columns, rows)

    def cut(self, ray_map: RayMap, rays: RayGrid) -> Float[Tensor, "rows columns"]:
        """Ranges of first returns on the window's rays, m; infinite where a ray meets nothing."""
        mapped, source = ray_map.first_return.nan_to_num(math.inf, posinf=math.inf), Window.of(ray_map, rays)
        if source == self:
            return mapped
        ranges = mapped.new_full(self.shape, math.inf)
        x, y = source.column - self.column, source.row - self.row
        inside = (slice(max(y, 0), max(0, y + source.rows)), slice(max(x, 0), max(0, x + source.columns)))
        ranges[inside] = mapped[max(-y, 0) : max(0, self.rows - y), max(-x, 0) : max(0, self.columns - x)]
        return ranges


@dataclass(frozen=True)
class Brick:
    """Box of voxels from `first` (included) to `end` (excluded)."""

    first: tuple[int, int, int]
    end: tuple[int, int, int]
    side_m: float
    """Side of a voxel, m."""

    def window(self, view: View, rays: RayGrid, beyond_m: float = 0.0) -> Window:
        """Rays of a view that cross the brick, or pass within `beyond_m` of it."""
        corners = np.where(_CORNERS, self.end, self.first) * self.side_m @ view.look.frame[:2].T
        return Window.around(np.concatenate([corners - beyond_m, corners + beyond_m]), rays)

    def holds(self, points: Float64[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Mask of the points in the brick."""
        cells = (points / self.side_m).floor()
        first, end = (cells.new_tensor(corner) for corner in (self.first, self.end))
        return ((cells >= first) & (cells < end)).all(1)

    def halves(self) -> "tuple[Brick, Brick]":
        """Cut the brick across its longest side."""
        axis = int(np.argmax(np.subtract(self.end, self.first)))
        middle = (self.first[axis] + self.end[axis]) // 2
        (x, y, z), (i, j, k) = (
            (middle if along == axis else corner for along, corner in enumerate(corners))
            for corners in (self.end, self.first)
        )
        return replace(self, end=(x, y, z)), replace(self, first=(i, j, k))


@dataclass(frozen=True)
class _Cubes:
    """Balls sorted by cubes of space."""

    order: Int64[np.ndarray, " n"]
    """Indices of the balls, sorted by cube."""
    starts: Int64[np.ndarray, " c"]
    """Start of each cube in `order`."""
    middles: Float64[np.ndarray, "c 3"]
    halves: Float64[np.ndarray, "c 3"]
    """Middle and half sides of the bounding box of each cube's balls, m."""

    @classmethod
    def of(cls, centres: Float64[np.ndarray, "n 3"], reach: Float64[np.ndarray, "n 1"]) -> "_Cubes":
        extent = centres - centres.min(0)
        cubes = np.floor(extent * (_CUBES / max(float(extent.max()), 1e-6))).astype(np.int64)  # the last is on the edge
        number = (cubes[:, 0] * (_CUBES + 1) + cubes[:, 1]) * (_CUBES + 1) + cubes[:, 2]
        order = np.argsort(number, kind="stable")
        starts = np.unique(number[order], return_index=True)[1]
        low, high = (
            np.minimum.reduceat((centres - reach)[order], starts),
            np.maximum.reduceat((centres + reach)[order], starts),
        )
        return cls(order, starts, (low + high) / 2, (high - low) / 2)


class Scene:
    """Gaussians sorted by cubes of space, to find those that the rays of a window meet."""

    def __init__(self, gaussians: Gaussians, rays: RayGrid) -> None:
        self.gaussians = gaussians
        self._step_m = max(rays.spacing_m)

    @cached_property
    def _means(self) -> Float64[np.ndarray, "n 3"]:
        return self.gaussians.means.double().cpu().numpy()

    @cached_property
    def _reach(self) -> Float64[np.ndarray, " n"]:
        """Distance of the farthest ray that each Gaussian touches, m, plus one spacing for float32's rounding."""
        g = self.gaussians
        depth, widest = (value.double().cpu().numpy() for value in (g.optical_depth, g.scales.amax(1)))
        deviations = np.sqrt(2 * np.log(np.maximum(depth / MIN_RAY_DEPTH, 1)))
        return deviations * np.sqrt(widest**2 + CELL_WIDENING * self._step_m**2) + self._step_m

    @cached_property
    def _cubes(self) -> _Cubes:
        return _Cubes.of(self._means, self._reach[:, None])

    def bricks(self, views: Sequence[View], rays: RayGrid, side_m: float, most_rays: float) -> Iterator[Brick]:
        """Bricks that contain Gaussians; all views together need at most `most_rays` rays for a brick."""
        low, high = (self._means - self._reach[:, None]).min(0), (self._means + self._reach[:, None]).max(0)
        first, end = np.floor(low / side_m).astype(int), np.floor(high / side_m).astype(int) + 1
        (i, j, k), (x, y, z) = first.tolist(), end.tolist()
        yield from self._halved(
            Brick((i, j, k), (x, y, z), side_m), np.arange(len(self._means)), views, rays, most_rays
        )

    def _halved(
        self, brick: Brick, index: Int64[np.ndarray, " k"], views: Sequence[View], rays: RayGrid, most_rays: float
    ) -> Iterator[Brick]:
        """Halve a brick until it is small enough; `index` are the Gaussians that may reach into it."""
        low, high = np.multiply(brick.first, brick.side_m), np.multiply(brick.end, brick.side_m)
        means, reach = self._means[index], self._reach[index, None]
        index = index[((means + reach >= low) & (means - reach <= high)).all(1)]
        if not len(index):
            return
        windows = (brick.window(view, rays) for view in views)
        if sum(window.rows * window.columns for window in windows) <= most_rays or max(high - low) <= max(
            _SMALLEST * self._step_m, brick.side_m
        ):
            yield brick
            return
        for half in brick.halves():
            yield from self._halved(half, index, views, rays, most_rays)

    def met_by(self, window: Window, view: View, rays: RayGrid) -> tuple[Int64[Tensor, " k"], Gaussians]:
        """Gaussians that rays of a window may meet: their indices, ascending, and a scene of them."""
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

    def widest_m(self, index: Int64[Tensor, " k"]) -> float:
        """Largest distance at which these Gaussians touch rays, m."""
        return float(self._reach[index.cpu().numpy()].max(initial=0))


def ray_count(gaussians: Gaussians, views: Sequence[View], rays: RayGrid) -> float:
    """Approximate number of rays of the views that cross the Gaussians' bounding box."""
    if not len(gaussians):
        return 0.0
    means, reach = gaussians.means.double().cpu().numpy(), 3 * float(gaussians.scales.max())
    sides = (np.ptp(view.look.frame[:2] @ means.T, axis=1) + 2 * reach for view in views)
    return sum(math.prod(side / rays.spacing_m) for side in sides)
