"""Points grouped by cubes of space, on any device (sums are in the order of rows, so bits repeat), or in halves."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Real
from torch import Tensor
from torch.nn.functional import normalize

_AT_ONCE, _AT_ONCE_ELSEWHERE = 8192, 1 << 16  # places in a batch; on the CPU, few, for its caches

CUBE = 0.15
"""Side of a surfel's cube, resolution cells."""

MOST_WAITING = 1 << 22
"""Number of points beyond which they are merged into voxels."""

MOST_POINTS = 1 << 20
"""Maximum number of points of a part, unless more coincide."""


def on_cpu(tensor: Tensor) -> bool:
    """True on the CPU, where trees and numpy are faster than the sorting that other devices do."""
    return tensor.device.type == "cpu"


def numbered(cells: Int64[Tensor, "p 3"]) -> Int64[Tensor, " p"]:
    """Number of each cell (x, y, z), ascending by x, then y, then z."""
    if not len(cells):
        return cells[:, 0]
    low, high = torch.aminmax(cells, dim=0)
    size = (high - low + 1).tolist()
    if math.prod(size) >= 1 << 62:  # overflow of int64
        return torch.unique(cells, dim=0, return_inverse=True)[1]
    x, y, z = (cells - low).unbind(1)
    return (x * size[1] + y) * size[2] + z


@dataclass(frozen=True)
class Groups:
    """Rows grouped by a number, in ascending order of these numbers."""

    order: Int64[Tensor, " p"]
    """Indices of the rows, sorted by group."""
    counts: Int64[Tensor, " g"]
    """Number of rows of each group."""

    @classmethod
    def of(cls, numbers: Int64[Tensor, " p"]) -> Self:
        """Group rows by their numbers."""
        ranked, order = numbers.sort(stable=True)
        return cls(order, torch.unique_consecutive(ranked, return_counts=True)[1])

    def sums(self, rows: Float64[Tensor, "p c"]) -> Float64[Tensor, "g c"]:
        """Sum of the rows of each group."""
        if not len(rows):
            return rows.new_zeros(len(self.counts), rows.shape[1])
        ranked = rows[self.order]
        return torch.segment_reduce(ranked, "sum", lengths=self.counts, axis=0, unsafe=True)  # checks would synchronise

    @property
    def first(self) -> Int64[Tensor, " g"]:
        """Index of each group's first row."""
        return self.order[self.counts.cumsum(0) - self.counts]

    @property
    def owner(self) -> Int64[Tensor, " p"]:
        """Group of each row."""
        groups = torch.arange(len(self.counts), device=self.order.device)
        ranked = groups.repeat_interleave(self.counts, output_size=len(self.order))
        return torch.empty_like(self.order).index_copy_(0, self.order, ranked)


def by_cubes(
    places: Float64[Tensor, "p 3"], side_m: float
) -> Iterator[tuple[Int64[Tensor, " k"], Float64[Tensor, "c 3"], Int64[Tensor, " k"]]]:
    """Batches of places: their rows, the middles of the cubes that contain them, m, and the index of each row's cube.

    A query at a cube's middle replaces those at its places, and does not depend on which other places there are.
    """
    cubes = (places / side_m).floor()
    numbers = numbered(cubes.long())
    for rows in numbers.argsort(stable=True).split(_AT_ONCE if on_cpu(places) else _AT_ONCE_ELSEWHERE):
        _, cube, counts = torch.unique_consecutive(numbers[rows], return_inverse=True, return_counts=True)
        yield rows, (cubes[rows[counts.cumsum(0) - counts]] + 0.5) * side_m, cube


@dataclass(frozen=True)
class Surfels:
    """Surfels: means of the points in small cubes, separate for the two sides of a sheet; S of P points."""

    places: Float64[Tensor, "s 3"]
    """Mean places of the points, m."""
    normals: Float64[Tensor, "s 3"]
    """Mean directions of the points' normals, of length 1."""
    counts: Float64[Tensor, " s"]
    """Number of points of each surfel."""
    owner: Int64[Tensor, " p"]
    """Surfel of each point."""

    @classmethod
    def of(cls, points: Float64[Tensor, "p 3"], normals: Float64[Tensor, "p 3"], side_m: float) -> Self:
        """Surfels of points, m, with directions, in cubes with sides of `side_m`."""
        cubes = numbered((points / side_m).floor().long())
        groups = Groups.of(cubes)
        behind = (normals * normals[groups.first][groups.owner]).sum(1) < 0
        groups = Groups.of(2 * cubes + behind)
        sums = groups.sums(torch.cat([points, normals, torch.ones_like(points[:, :1])], dim=1))
        place, normal, counts = sums.split([3, 3, 1], dim=1)
        return cls(place / counts, normalize(normal, dim=1), counts[:, 0], groups.owner)


def dot(one: Float64[Tensor, "*#q c"], other: Float64[Tensor, "*#q c"]) -> Float64[Tensor, "*#q"]:
    """Scalar products, ten times as fast as `sum` over few coordinates."""
    total = one[..., 0] * other[..., 0]
    for k in range(1, one.shape[-1]):
        total = total + one[..., k] * other[..., k]
    return total


class Voxels:
    """Thinning of points to one mean per cube with a side of `side_m`, on the points' device."""

    def __init__(self, side_m: float, device: torch.device | str = "cpu") -> None:
        self._side_m = side_m
        self._cells = torch.empty(0, 3, dtype=torch.int64, device=device)
        self._sums = torch.empty(0, 4, dtype=torch.float64, device=device)  # coordinates and number
        self._waiting: list[Float64[Tensor, "p 3"]] = []

    def add(self, points: Float64[Tensor, "p 3"]) -> None:
        """Add points."""
        self._waiting.append(points)
        if sum(map(len, self._waiting)) > MOST_WAITING:
            self._merge()

    def means(self) -> Float64[Tensor, "v 3"]:
        """Mean of the points in each cube that has any."""
        self._merge()
        return self._sums[:, :3] / self._sums[:, 3:]

    def _merge(self) -> None:
        points, self._waiting = torch.cat([self._sums[:0, :3], *self._waiting]), []
        self._sums = torch.cat([self._sums, torch.cat([points, torch.ones_like(points[:, :1])], dim=1)])
        places = torch.cat([self._cells, (points / self._side_m).floor().long()])
        groups = Groups.of(numbered(places))
        self._cells, self._sums = places[groups.first], groups.sums(self._sums)


# ---- parts of a cloud ------------------------------------------------------------------------------------------------
def parts_of(
    points: Real[np.ndarray, "p 3"], reach_m: float, most: int = MOST_POINTS
) -> Iterator[tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]]:
    """Split a cloud into parts: indices of a part's points and all within `reach_m`, and a mask of the part's points.

    Each point belongs to one part. A cloud of at most `most` points is one part.
    """
    parts = [(np.arange(len(points)), np.ones(len(points), bool))]
    while parts:
        index, own = parts.pop()
        own_points = points[index[own]]
        sides = np.ptp(own_points, axis=0) if len(own_points) else np.zeros(3)
        axis = int(sides.argmax())
        if len(own_points) <= most or sides[axis] <= 2 * reach_m:
            yield index, own
            continue
        middle, place, lowest = float(np.median(own_points[:, axis])), points[index, axis], own_points[:, axis].min()
        if middle == lowest:  # most points coincide there: cut behind them
            middle = float(own_points[own_points[:, axis] > lowest, axis].min())
        for side, near in ((place >= middle, place >= middle - reach_m), (place < middle, place < middle + reach_m)):
            parts.append((index[near], (own & side)[near]))  # the lower half comes next
