"""Which points are near a place: on the CPU by scipy's trees, which are faster there.

On other devices they are sorted by cubes, and those of 3 × 3 × 3 cubes are looked at.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Real
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.surface import cells
from sarsplat.uninterruptible import uninterruptible

_PAIRS = 1 << 22
"""Pairs of a place and a point that are looked at at once: memory."""

_MEASURED = 10_000
"""Points, at most, how far the next one is."""


@dataclass(frozen=True)
class _Pairs:
    """Places, and all points in the cubes around each: those of the first place, of the second, …"""

    places: slice
    owner: Int64[Tensor, " m"]
    """Which of these places."""
    row: Int64[Tensor, " m"]
    """Which of the cubes' points."""
    counts: Int64[Tensor, " q"]
    """Points of each place."""


class _Cubes:
    """Points sorted by the cubes of a side, m, in which they lie, with an empty cube beyond the last on all sides."""

    def __init__(self, points: Float64[Tensor, "n 3"], side_m: float) -> None:
        self._side_m = side_m
        self._low, high = points.aminmax(dim=0)
        self._size = ((high - self._low) / side_m).floor().long() + 3
        _, self._rows, self._layers = self._size.tolist()
        self._numbers, self.order = self._numbered(self._cubes_of(points)).sort(stable=True)
        self.points = points[self.order]

    def _cubes_of(self, places: Float64[Tensor, "q 3"]) -> Int64[Tensor, "q 3"]:
        """The cube of each place; of those farther away, an empty one."""
        return ((places - self._low) / self._side_m).floor().add(1).clamp(min=0).minimum(self._size - 1).long()

    def _numbered(self, cubes: Int64[Tensor, "q 3"]) -> Int64[Tensor, " q"]:
        x, y, z = cubes.unbind(1)
        return (x * self._rows + y) * self._layers + z

    def pairs(self, places: Float64[Tensor, "q 3"]) -> Iterator[_Pairs]:
        """Some places at a time."""
        side = torch.arange(-1, 2, device=places.device)
        columns = (side[:, None] * self._rows + side).flatten() * self._layers  # of three cubes along z each
        middle = self._numbered(self._cubes_of(places))[:, None] + columns
        first = torch.searchsorted(self._numbers, middle - 1)
        counts = torch.searchsorted(self._numbers, middle + 1, right=True) - first
        of_places = counts.sum(1)
        ends = of_places.cumsum(0)
        blocks = int(ends[-1]) // _PAIRS + 1
        cuts = torch.searchsorted(ends, torch.arange(1, blocks, device=ends.device) * _PAIRS, right=True)
        cuts = torch.cat([cuts.new_zeros(1), cuts, cuts.new_full((1,), len(places))])
        before = torch.cat([ends.new_zeros(1), ends])[cuts]
        found = torch.stack([cuts, before], dim=1).tolist()
        for (begin, done), (end, then) in pairwise(found):
            if begin == end:
                continue
            some, many = slice(begin, end), counts[begin:end].flatten()
            number = torch.arange(len(many), device=many.device).repeat_interleave(many, output_size=then - done)
            start = first[some].flatten() - (many.cumsum(0) - many)
            row = torch.arange(then - done, device=many.device) + start[number]
            yield _Pairs(some, number // len(columns), row, of_places[some])

    def seen_around(self, places: Float64[Tensor, "q 3"]) -> Float64[Tensor, " q"]:
        """How far from each place no point is missed, m."""
        cube = self._cubes_of(places)
        below = places - (self._low + (cube - 2) * self._side_m)
        above = self._low + (cube + 1) * self._side_m - places
        below, above = below.where(cube > 2, math.inf), above.where(cube < self._size - 3, math.inf)
        return below.minimum(above).amin(1)


class Tree:
    """Points on the CPU that are asked for again and again."""

    def __init__(self, points: Float64[Tensor, "n 3"]) -> None:
        self._tree = cKDTree(points.numpy(), leafsize=32, balanced_tree=False, compact_nodes=False)  # the fastest

    def nearest(
        self, places: Float64[Tensor, "q 3"], count: int
    ) -> tuple[Float64[Tensor, "q k"], Int64[Tensor, "q k"]]:
        """As of `Neighbours`."""
        apart, index = uninterruptible(self._tree.query, places.numpy(), k=np.arange(1, count + 1), workers=-1)
        return torch.from_numpy(apart).square_(), torch.from_numpy(index)


def neighbours_of(points: Float64[Tensor, "n 3"]) -> Tree | Neighbours:
    """Ready to be asked, where the points are."""
    return Tree(points) if cells.on_cpu(points) else Neighbours(points)


def spacing_m(points: Real[np.ndarray, "p 3"]) -> float:
    """How far apart points are, m: from the next one, in the median of some; none or one are 0 apart."""
    there = torch.from_numpy(np.asarray(points, np.float64))
    if len(there) < 2:
        return 0.0
    some = there[:: math.ceil(len(there) / _MEASURED)]
    return math.sqrt(float(Tree(there).nearest(some, 2)[0][:, 1].median()))


class Neighbours:
    """Points that are asked for again and again."""

    def __init__(self, points: Float64[Tensor, "n 3"]) -> None:
        self._points = points
        self._cubes: dict[float, _Cubes] = {}

    def nearest(
        self, places: Float64[Tensor, "q 3"], count: int
    ) -> tuple[Float64[Tensor, "q k"], Int64[Tensor, "q k"]]:
        """Squared distances, m², of so many points around each place, the nearest first, and which they are.

        There must be so many points. Those equally far away to seven digits may change places.
        """
        apart = places.new_empty(len(places), count)
        index = torch.empty(len(places), count, dtype=torch.int64, device=places.device)
        left, side_m = torch.arange(len(places), device=places.device), _first_side(self._points, count)
        while len(left):
            if side_m not in self._cubes:
                self._cubes[side_m] = _Cubes(self._points, side_m)
            cubes, asked = self._cubes[side_m], places[left]
            within = cubes.seen_around(asked).square()
            found = torch.zeros_like(left, dtype=torch.bool)
            for some in cubes.pairs(asked):
                squares = (cubes.points[some.row] - asked[some.places][some.owner]).square_().sum(1)
                best, there = _smallest(squares, some.owner, some.counts, count)
                square = squares[best].where(there, math.inf)
                found[some.places] = square[:, -1] <= within[some.places]
                apart[left[some.places]], index[left[some.places]] = square, cubes.order[some.row[best]]
            left, side_m = left[~found], 2 * side_m
        return apart, index


def _first_side(points: Float64[Tensor, "n 3"], count: int) -> float:
    """A side of cubes, m, that hold about so many points of a surface."""
    low, high = points.aminmax(dim=0)
    _, width, length = sorted((high - low).tolist())
    share = count / len(points)
    return max(math.sqrt(width * length * share), length * share) or 1.0


def _smallest(
    values: Float64[Tensor, " m"], owner: Int64[Tensor, " m"], counts: Int64[Tensor, " q"], count: int
) -> tuple[Int64[Tensor, "q k"], Bool[Tensor, "q k"]]:
    """So many smallest values, ≥ 0, of each owner, by rows of all values, and whether it has so many."""
    # one number is sorted: the bits of floats that are not negative are ordered as they are
    order = ((owner << 32) + values.float().view(torch.int32)).argsort(stable=True)
    number = torch.arange(count, device=counts.device)
    first = counts.cumsum(0) - counts
    return order[(first[:, None] + number).clamp(max=len(order) - 1)], number < counts[:, None]
