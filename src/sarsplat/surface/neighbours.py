"""Nearest neighbours of places: by scipy's k-d trees on the CPU, by cubes of space on other devices."""

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
from sarsplat.threads import uninterruptible

_PAIRS = 1 << 22  # maximum number of pairs of a place and a point in a batch, to bound memory
_MEASURED = 10_000  # maximum number of points whose nearest neighbour gives the spacing


@dataclass(frozen=True)
class _Pairs:
    """Batch of places, and all pairs of a place and a point in the 3 × 3 × 3 cubes around it, ordered by place."""

    places: slice
    owner: Int64[Tensor, " m"]
    """Place of each pair, within the batch."""
    row: Int64[Tensor, " m"]
    """Point of each pair, in the order of the cubes."""
    counts: Int64[Tensor, " q"]
    """Number of pairs of each place."""


class _Cubes:
    """Points sorted by cubes with sides of `side_m`; a layer of empty cubes surrounds them."""

    def __init__(self, points: Float64[Tensor, "n 3"], side_m: float) -> None:
        self._side_m = side_m
        self._low, high = points.aminmax(dim=0)
        self._size = ((high - self._low) / side_m).floor().long() + 3
        _, self._rows, self._layers = self._size.tolist()
        self._numbers, self.order = self._numbered(self._cubes_of(points)).sort(stable=True)
        self.points = points[self.order]

    def _cubes_of(self, places: Float64[Tensor, "q 3"]) -> Int64[Tensor, "q 3"]:
        """Cube of each place; places outside get the nearest empty cube."""
        return ((places - self._low) / self._side_m).floor().add(1).clamp(min=0).minimum(self._size - 1).long()

    def _numbered(self, cubes: Int64[Tensor, "q 3"]) -> Int64[Tensor, " q"]:
        x, y, z = cubes.unbind(1)
        return (x * self._rows + y) * self._layers + z

    def pairs(self, places: Float64[Tensor, "q 3"]) -> Iterator[_Pairs]:
        """Pairs of places and points, in batches."""
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
            batch, lengths = slice(begin, end), counts[begin:end].flatten()
            number = torch.arange(len(lengths), device=lengths.device)
            number = number.repeat_interleave(lengths, output_size=then - done)
            start = first[batch].flatten() - (lengths.cumsum(0) - lengths)
            row = torch.arange(then - done, device=lengths.device) + start[number]
            yield _Pairs(batch, number // len(columns), row, of_places[batch])

    def complete_within(self, places: Float64[Tensor, "q 3"]) -> Float64[Tensor, " q"]:
        """Radius around each place in which its pairs include all points, m."""
        cube = self._cubes_of(places)
        below = places - (self._low + (cube - 2) * self._side_m)
        above = self._low + (cube + 1) * self._side_m - places
        below, above = below.where(cube > 2, math.inf), above.where(cube < self._size - 3, math.inf)
        return below.minimum(above).amin(1)


class Tree:
    """k-d tree of points on the CPU."""

    def __init__(self, points: Float64[Tensor, "n 3"]) -> None:
        self._tree = cKDTree(points.numpy(), leafsize=32, balanced_tree=False, compact_nodes=False)  # the fastest

    def nearest(
        self, places: Float64[Tensor, "q 3"], count: int
    ) -> tuple[Float64[Tensor, "q k"], Int64[Tensor, "q k"]]:
        """See `Neighbours.nearest`."""
        distance, index = uninterruptible(self._tree.query, places.numpy(), k=np.arange(1, count + 1), workers=-1)
        return torch.from_numpy(distance).square_(), torch.from_numpy(index)


def neighbours_of(points: Float64[Tensor, "n 3"]) -> "Tree | Neighbours":
    """Search structure on the points' device."""
    return Tree(points) if cells.on_cpu(points) else Neighbours(points)


def spacing_m(points: Real[np.ndarray, "p 3"]) -> float:
    """Spacing of points, m: median distance to the nearest other one, in a sample; 0 for fewer than two points."""
    cloud = torch.from_numpy(np.asarray(points, np.float64))
    if len(cloud) < 2:
        return 0.0
    sample = cloud[:: math.ceil(len(cloud) / _MEASURED)]
    return math.sqrt(float(Tree(cloud).nearest(sample, 2)[0][:, 1].median()))


class Neighbours:
    """Points sorted by cubes of space, for searches on any device."""

    def __init__(self, points: Float64[Tensor, "n 3"]) -> None:
        self._points = points
        self._cubes: dict[float, _Cubes] = {}

    def nearest(
        self, places: Float64[Tensor, "q 3"], count: int
    ) -> tuple[Float64[Tensor, "q k"], Int64[Tensor, "q k"]]:
        """Squared distances, m², and indices of the `count` points nearest to each place, nearest first.

        There must be at least `count` points. Points equally far to seven digits may be swapped.
        """
        squared = places.new_empty(len(places), count)
        index = torch.empty(len(places), count, dtype=torch.int64, device=places.device)
        left, side_m = torch.arange(len(places), device=places.device), _first_side(self._points, count)
        while len(left):
            if side_m not in self._cubes:
                self._cubes[side_m] = _Cubes(self._points, side_m)
            cubes, remaining = self._cubes[side_m], places[left]
            within = cubes.complete_within(remaining).square()
            found = torch.zeros_like(left, dtype=torch.bool)
            for batch in cubes.pairs(remaining):
                squares = (cubes.points[batch.row] - remaining[batch.places][batch.owner]).square_().sum(1)
                best, valid = _smallest(squares, batch.owner, batch.counts, count)
                square = squares[best].where(valid, math.inf)
                found[batch.places] = square[:, -1] <= within[batch.places]
                squared[left[batch.places]], index[left[batch.places]] = square, cubes.order[batch.row[best]]
            left, side_m = left[~found], 2 * side_m
        return squared, index


def _first_side(points: Float64[Tensor, "n 3"], count: int) -> float:
    """Side of cubes, m, that contain about `count` points of a surface."""
    low, high = points.aminmax(dim=0)
    _, width, length = sorted((high - low).tolist())
    share = count / len(points)
    return max(math.sqrt(width * length * share), length * share) or 1.0


def _smallest(
    values: Float64[Tensor, " m"], owner: Int64[Tensor, " m"], counts: Int64[Tensor, " q"], count: int
) -> tuple[Int64[Tensor, "q k"], Bool[Tensor, "q k"]]:
    """Indices of the `count` smallest values (≥ 0) of each owner, and a mask, False beyond an owner's values."""
    # sort one integer: the bits of non-negative floats are ordered as the floats
    order = ((owner << 32) + values.float().view(torch.int32)).argsort(stable=True)
    number = torch.arange(count, device=counts.device)
    first = counts.cumsum(0) - counts
    return order[(first[:, None] + number).clamp(max=len(order) - 1)], number < counts[:, None]
