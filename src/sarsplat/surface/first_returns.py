"""First returns of many views: at once on a GPU, where only sizes are copied to the CPU, or view by view on the CPU."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Real
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.renderer import render
from sarsplat.surface import cells
from sarsplat.surface.bricks import Brick, Scene, Window
from sarsplat.tiles import at_once

_AT_ONCE = 1 << 22  # maximum number of rays, and of pairs of a point and a view, in a batch
_WORTH = 0.9  # share of remaining points below which the dropped ones are removed from arrays, on the CPU


def view_batches(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> Iterator[list[View]]:
    """Batches of views, in their order: as many as fit into a GPU's memory; single views on the CPU, for its caches."""
    most = 1
    if len(gaussians) and not cells.on_cpu(gaussians.means):
        most = max(1, at_once(gaussians, views, grid, rays))
    return (list(views[k : k + most]) for k in range(0, len(views), most))


def traced(
    scene: Scene,
    brick: Brick | None,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    optical_depth: float,
    advance: Callable[[int], object],
) -> Iterator[tuple[View, Window, Float[Tensor, "rows columns"]]]:
    """Views, their rays (all, or those of a brick), and ranges of first return, m; infinite where a ray meets nothing.

    Views are rendered in batches, or one by one for a brick; `advance` gets numbers of views.
    """
    pixel = replace(grid, rows=1, columns=1)  # images are not needed
    batches = view_batches(scene.gaussians, views, pixel, rays) if brick is None else ([view] for view in views)
    for batch in batches:
        window = None if brick is None else brick.window(batch[0], rays)
        gaussians = scene.gaussians if window is None else scene.met_by(window, batch[0], rays)[1]
        black = gaussians.means.new_zeros(len(batch), len(gaussians), 1)
        done = render(gaussians, batch, pixel, rays=rays, first_return_depth=optical_depth, amplitudes=black)
        for view, ray_map in zip(batch, done.ray_maps or (), strict=True):
            own = window or Window.of(ray_map, rays)
            yield view, own, own.cut(ray_map, rays)
        advance(len(batch))


@dataclass(frozen=True)
class FirstReturns:
    """First returns of the rays of V views."""

    windows: Sequence[Window]
    """Rays of each view."""
    range_m: Float[Tensor, " r"]
    """Ranges of all rays, view by view, m; infinite where a ray meets nothing."""
    frames: Float64[Tensor, "v 3 3"]
    """Rotations R_r from the world to the radar frame."""
    spacing_m: tuple[float, float]

    @classmethod
    def of(cls, found: Iterable[tuple[View, Window, Float[Tensor, "rows columns"]]], rays: RayGrid) -> Self:
        """Collect what `traced` finds."""
        views, windows, ranges = zip(*found, strict=True)
        frames = torch.from_numpy(np.stack([view.look.frame for view in views])).to(ranges[0].device)
        return cls(windows, torch.cat([of_view.flatten() for of_view in ranges]), frames, rays.spacing_m)

    @property
    def _sizes(self) -> list[int]:
        """Number of rays of each view."""
        return [window.rows * window.columns for window in self.windows]

    def points(self, terrain: Terrain | None, lowest_m: float) -> Iterator[Float64[Tensor, "p 3"]]:
        """Returns of each view, world frame, m, that are at least `lowest_m` above the terrain."""
        ranges = self.range_m.split(self._sizes)
        count = max(1, _AT_ONCE // max(self._sizes))
        for first in range(0, len(ranges), count):
            block = range(first, min(first + count, len(ranges)))
            yield from self._points_of(block, ranges, terrain, lowest_m)

    def _points_of(
        self, views: Sequence[int], ranges: Sequence[Tensor], terrain: Terrain | None, lowest_m: float
    ) -> Sequence[Float64[Tensor, "p 3"]]:
        """Returns of a block of views, as `points` yields them; waits for a GPU once."""
        placed = [self._placed(view, ranges[view]) for view in views]
        points, finite = torch.cat(placed), torch.cat([ranges[view] for view in views]).isfinite()
        keep = finite & (_heights(points, terrain) >= lowest_m)
        ends = torch.from_numpy(np.cumsum([len(returns) for returns in placed])).to(keep.device)
        kept_until = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])[ends].tolist()
        return points[keep].split(np.diff([0, *kept_until]).tolist())

    def _placed(self, view: int, ranges: Float[Tensor, " r"]) -> Float64[Tensor, "r 3"]:
        """Points of first return of a view's rays, world frame, m; arbitrary for rays that meet nothing."""
        window, (rows, columns) = self.windows[view], self.windows[view].shape
        # rounded as on the CPU, since voxels and rays may share edges
        x = (np.arange(columns) + (window.column + 0.5)) * self.spacing_m[0]
        y = (np.arange(rows) + (window.row + 0.5)) * self.spacing_m[1]
        local = ranges.new_empty(rows, columns, 3, dtype=torch.float64)
        local[..., 0], local[..., 1] = torch.from_numpy(x).to(local), torch.from_numpy(y).to(local)[:, None]
        local[..., 2] = ranges.nan_to_num(posinf=0.0).view(rows, columns)
        return local.view(-1, 3) @ self.frames[view]

    def confirmed(
        self,
        points: Float64[Tensor, "p 3"],
        behind_m: float,
        seen_through: float,
        seen_by: int,
        advance: Callable[[int], object],
    ) -> Int64[Tensor, " k"]:
        """Indices of points that enough views see and few views look through.

        A view sees a point if its first return is within `behind_m` of it, and looks through it if it is farther. At
        least `seen_by` views must see it; at most the share `seen_through` of the views may look through.
        """
        through, seen = torch.zeros(2, len(points), dtype=torch.int64, device=points.device)
        sizes, new = self._sizes, partial(torch.tensor, device=points.device)
        shapes = new([window.shape for window in self.windows])
        firsts = new(np.cumsum([0, *sizes[:-1]]))
        corners = new([(window.column, window.row) for window in self.windows], dtype=torch.float64)
        spacing = new(self.spacing_m, dtype=torch.float64)
        count = max(1, _AT_ONCE // max(1, len(points)))
        for k in range(0, len(sizes), count):
            batch = slice(k, k + count)
            local = (points @ self.frames[batch].flatten(0, 1).T).view(len(points), -1, 3)
            place = (local[..., :2] / spacing - 0.5).round() - corners[batch]
            (column, row), (rows, columns) = place.unbind(-1), shapes[batch].unbind(1)
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            ray = (firsts[batch] + row * columns + column).where(inside, 0).long()
            beyond = self.range_m[ray].double().where(inside, math.inf) - local[..., 2]  # m from point to first return
            through += (beyond > behind_m).sum(1)
            seen += (beyond.abs() <= behind_m).sum(1)
            advance(len(sizes[batch]))
        return ((through <= seen_through * len(sizes)) & (seen >= seen_by)).nonzero()[:, 0]


def _heights(points: Float64[Tensor, "p 3"], terrain: Terrain | None) -> Float64[Tensor, " p"]:
    """Heights of points above the terrain, or above z = 0, m: `heights_of` on any device."""
    if terrain is None:
        return points[:, 2]
    table = torch.from_numpy(terrain.heights_m).to(points.device)
    (ny, nx), before, share = table.shape, [], []
    for coordinate, half, pitch, count in zip(points.T, terrain.half_m, terrain.pitch_m, (nx, ny)):
        place = ((coordinate + half) / pitch).clamp(0, count - 1)
        before.append(place.long().clamp(max=count - 2))
        share.append(place - before[-1])
    corner, (right, down) = before[1] * nx + before[0], share
    upper, lower = (
        table.flatten()[corner + step] * (1 - right) + table.flatten()[corner + step + 1] * right for step in (0, nx)
    )
    return points[:, 2] - (upper * (1 - down) + lower * down)


# ---- on the CPU ----
@dataclass(frozen=True)
class FirstReturnsOnCpu:
    """First returns of the rays of V views, all of them or those of a brick; interface of `FirstReturns`."""

    views: "Sequence[OfView]"

    @classmethod
    def of(cls, found: Iterable[tuple[View, Window, Float[Tensor, "rows columns"]]], rays: RayGrid) -> Self:
        """Collect what `traced` finds."""
        return cls([OfView.of(*of_view, rays) for of_view in found])

    def points(self, terrain: Terrain | None, lowest_m: float) -> Iterator[Float64[Tensor, "p 3"]]:
        """Returns of each view, world frame, m, that are at least `lowest_m` above the terrain."""
        for view in self.views:
            points = view.points()
            yield torch.from_numpy(points[heights_of(points, terrain) >= lowest_m])

    def confirmed(
        self,
        points: Float64[Tensor, "p 3"],
        behind_m: float,
        seen_through: float,
        seen_by: int,
        advance: Callable[[int], object],
    ) -> Int64[Tensor, " k"]:
        """See `FirstReturns.confirmed`."""
        index, places = np.arange(len(points)), np.ascontiguousarray(points.numpy().T)
        through, seen = np.zeros((2, len(points)), np.uint8 if len(self.views) < 256 else np.int64)
        for number in _mixed(len(self.views)):  # different directions drop isolated points soon
            beyond = self.views[number].beyond(places.T)
            through += beyond > behind_m
            seen += np.abs(beyond, out=beyond) <= behind_m
            keep = through <= seen_through * len(self.views)
            if keep.sum() <= _WORTH * len(index):
                index, places, through, seen = index[keep], places[:, keep], through[keep], seen[keep]
            advance(1)
        return torch.from_numpy(index[(through <= seen_through * len(self.views)) & (seen >= seen_by)])


def _mixed(count: int) -> Int64[np.ndarray, " n"]:
    """Indices 0 … count − 1 in an order in which consecutive ones are far apart: by multiples of the golden ratio."""
    return np.argsort(np.arange(count) * (5**0.5 - 1) / 2 % 1, kind="stable")


@dataclass(frozen=True)
class OfView:
    """First returns of the rays of one view, all of them or those of a brick."""

    frame: Float64[np.ndarray, "3 3"]
    """Rotation R_r from the world to the radar frame."""
    range_m: Real[np.ndarray, "rows columns"]
    """Ranges on the rays' lattice, with one more ray on each side; infinite where a ray meets nothing."""
    first: tuple[int, int]
    """Column and row of the first ray in the lattice."""
    spacing_m: tuple[float, float]

    @classmethod
    def of(cls, view: View, window: Window, ranges: Float[Tensor, "rows columns"], rays: RayGrid) -> "OfView":
        """First returns of what `traced` finds for one view."""
        padded = np.pad(ranges.numpy(), 1, constant_values=np.inf)
        return cls(view.look.frame, padded, (window.column - 1, window.row - 1), rays.spacing_m)

    def points(self) -> Float64[np.ndarray, "p 3"]:
        """Returns, world frame, m."""
        row, column = np.nonzero(np.isfinite(self.range_m))
        # from lattice indices, and without a matrix product, so that rounding does not depend on the brick
        x = (column + (self.first[0] + 0.5)) * self.spacing_m[0]
        y = (row + (self.first[1] + 0.5)) * self.spacing_m[1]
        z = self.range_m[row, column].astype(np.float64)
        return np.stack([x * a + y * b + z * c for a, b, c in self.frame.T], axis=1)

    def beyond(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
        """Distance from each point back to the first return of its ray, m, [P]; infinite if the ray meets nothing."""
        # without a matrix product, whose rounding may depend on the number of points
        across, along, away = (points[:, 0] * x + points[:, 1] * y + points[:, 2] * z for x, y, z in self.frame)
        rows, columns = self.range_m.shape
        for places, step, first, count in zip(
            (across, along), self.spacing_m, self.first, (columns, rows), strict=True
        ):
            places /= step
            places -= 0.5
            np.rint(places, out=places)
            places -= first
            np.clip(places, 0, count - 1, out=places)
        along *= columns
        along += across
        return np.subtract(self.range_m.ravel()[along.astype(np.int64)], away, out=away)
