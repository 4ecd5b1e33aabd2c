"""First returns of many views on the CPU, view by view: points that are dropped early cost no more time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Float64, Int64, Real
from torch import Tensor

from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.surface.bricks import Brick, Scene, Window
from sarsplat.surface.first_returns import traced

_WORTH = 0.9  # share of remaining points below which the dropped ones are removed from arrays


@dataclass(frozen=True)
class FirstReturnsOnCpu:
    """First returns of the rays of V views, all of them or those of a brick; interface of `FirstReturns`."""

    views: Sequence[OfView]

    @classmethod
    def of(
        cls,
        scene: Scene,
        brick: Brick | None,
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        optical_depth: float,
        advance: Callable[[int], object],
    ) -> Self:
        """Trace the rays view by view; `advance` gets numbers of views."""
        found = []
        for view in views:
            found.append(OfView.of(scene, brick, view, grid, rays, optical_depth))
            advance(1)
        return cls(found)

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
    """Indices 0 … count − 1 in an order in which consecutive ones are far apart."""
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
    def of(
        cls, scene: Scene, brick: Brick | None, view: View, grid: ImageGrid, rays: RayGrid, optical_depth: float
    ) -> OfView:
        window = None if brick is None else brick.window(view, rays)
        gaussians = scene.gaussians if window is None else scene.met_by(window, view, rays)[1]
        (ray_map,) = traced(gaussians, [view], replace(grid, rows=1, columns=1), rays, optical_depth)
        window = window or Window.of(ray_map, rays)
        ranges = np.pad(window.cut(ray_map, rays).numpy(), 1, constant_values=np.inf)
        return cls(view.look.frame, ranges, (window.column - 1, window.row - 1), rays.spacing_m)

    def points(self) -> Float64[np.ndarray, "p 3"]:
        row, column = np.nonzero(np.isfinite(self.range_m))
        # from lattice indices, and without a matrix product, so that rounding does not depend on the brick
        x = (column + (self.first[0] + 0.5)) * self.spacing_m[0]
        y = (row + (self.first[1] + 0.5)) * self.spacing_m[1]
        z = self.range_m[row, column].astype(np.float64)
        return np.stack([x * a + y * b + z * c for a, b, c in self.frame.T], axis=1)

    def beyond(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
        """Distance from each point back to the first return of its ray, m, [P]; infinite if the ray meets nothing."""
        across, along, away = (self._sum(points, axis) for axis in self.frame)
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

    @staticmethod
    def _sum(points: Float64[np.ndarray, "p 3"], axis: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " p"]:
        """Coordinate along an axis, m; a matrix product's rounding may depend on the number of points."""
        total = points[:, 0] * axis[0]
        total += points[:, 1] * axis[1]
        total += points[:, 2] * axis[2]
        return total
