"""Which points are near a place, on any device: they are sorted by cubes, and those of 3 × 3 × 3 cubes are looked at.

On the CPU scipy's trees are faster.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from sarsplat.surface.cells import sums_of

_PAIRS = 1 << 22
"""Pairs of a place and a point that are looked at at once: memory."""


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


@dataclass(frozen=True)
class _Cubes:
    """Points sorted by the cubes of a side in which they lie, with an empty cube beyond the last on all sides."""

    side_m: float
    low: Float64[Tensor, " 3"]
    size: tuple[int, int, int]
    numbers: Int64[Tensor, " n"]
    order: Int64[Tensor, " n"]
    points: Float64[Tensor, "n 3"]

    @classmethod
    def of(cls, points: Float64[Tensor, "n 3"], side_m: float) -> Self:
        low, high = points.aminmax(dim=0)
        x, y, z = ((high - low) / side_m).floor().long().add(3).tolist()
        cubes = cls(side_m, low, (x, y, z), *2 * (points.new_empty(0, dtype=torch.int64),), points)
        numbers, order = cubes._numbered(cubes._cubes_of(points)).sort(stable=True)
        return cls(side_m, low, (x, y, z), numbers, order, points[order])

    def _cubes_of(self, places: Float64[Tensor, "q 3"]) -> Int64[Tensor, "q 3"]:
        """The cube of each place; of those farther away, an empty one."""
        last = torch.tensor(self.size, device=places.device) - 1
        return ((places - self.low) / self.side_m).floor().add(1).clamp(min=0).minimum(last).long()

    def _numbered(self, cubes: Int64[Tensor, "*q 3"]) -> Int64[Tensor, "*q"]:
        _, ny, nz = self.size
        return (cubes[..., 0] * ny + cubes[..., 1]) * nz + cubes[..., 2]

    def pairs(self, places: Float64[Tensor, "q 3"]) -> Iterator[_Pairs]:
        """Some places at a time."""
        side = torch.arange(-1, 2, device=places.device)
        columns = (side[:, None] * self.size[1] + side).flatten() * self.size[2]  # of three cubes along z each
        middle = self._numbered(self._cubes_of(places))[:, None] + columns
        first = torch.searchsorted(self.numbers, middle - 1)
        counts = torch.searchsorted(self.numbers, middle + 1, right=True) - first
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
        cube, size = self._cubes_of(places), torch.tensor(self.size, device=places.device)
        below = places - (self.low + (cube - 2) * self.side_m)
        above = self.low + (cube + 1) * self.side_m - places
        below, above = below.where(cube > 2, math.inf), above.where(cube < size - 3, math.inf)
        return below.minimum(above).amin(1)


def sums_within(
    points: Float64[Tensor, "n 3"], values: Float64[Tensor, "n c"], radius: float
) -> Float64[Tensor, "n c"]:
    """Sums of what points have, each over those within a radius, m, of it, itself included."""
    if not len(points):
        return values
    cubes, sums = _Cubes.of(points, radius), torch.empty_like(values)
    values = values[cubes.order]
    for some in cubes.pairs(points):
        apart = cubes.points[some.row] - points[some.places][some.owner]
        near = apart.square_().sum(1) <= radius**2
        sums[some.places] = sums_of(values[some.row] * near[:, None], some.counts)
    return sums


def nearest(
    points: Float64[Tensor, "n 3"], places: Float64[Tensor, "q 3"], count: int
) -> tuple[Float64[Tensor, "q k"], Int64[Tensor, "q k"]]:
    """Squared distances, m², of so many points around each place, the nearest first, and which they are.

    There must be so many points. Those equally far away to seven digits may change places.
    """
    apart = places.new_empty(len(places), count)
    index = torch.empty(len(places), count, dtype=torch.int64, device=places.device)
    left, side_m = torch.arange(len(places), device=places.device), _first_side(points, count)
    while len(left):
        cubes, asked = _Cubes.of(points, side_m), places[left]
        within = cubes.seen_around(asked).square()
        found = torch.zeros_like(left, dtype=torch.bool)
        for some in cubes.pairs(asked):
            apart2 = (cubes.points[some.row] - asked[some.places][some.owner]).square_().sum(1)
            best, there = _smallest(apart2, some.owner, some.counts, count)
            squares = apart2[best].where(there, math.inf)
            found[some.places] = squares[:, -1] <= within[some.places]
            apart[left[some.places]], index[left[some.places]] = squares, cubes.order[some.row[best]]
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
