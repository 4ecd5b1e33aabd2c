"""What lies in the same cubes of space, on any device: sums in the order of the rows, the same bits each time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

_AT_ONCE, _AT_ONCE_ELSEWHERE = 8192, 1 << 16  # places: on the CPU, what is calculated of them stays in its caches


def on_cpu(tensor: Tensor) -> bool:
    """Whether it lies where trees and numpy are faster than sorting, which is for all other devices."""
    return tensor.device.type == "cpu"


def numbered(cells: Int64[Tensor, "p 3"]) -> Int64[Tensor, " p"]:
    """A number for each cell (x, y, z), in whose order they are sorted by x, then y, then z."""
    if not len(cells):
        return cells[:, 0]
    low, high = torch.aminmax(cells, dim=0)
    size = (high - low + 1).tolist()
    if math.prod(size) >= 1 << 62:  # no number counts so many
        return torch.unique(cells, dim=0, return_inverse=True)[1]
    x, y, z = (cells - low).unbind(1)
    return (x * size[1] + y) * size[2] + z


@dataclass(frozen=True)
class Groups:
    """Rows of the same number, in the order of these numbers."""

    order: Int64[Tensor, " p"]
    """The rows, those of a group one after the other."""
    counts: Int64[Tensor, " g"]
    """How many rows each group has."""

    @classmethod
    def of(cls, numbers: Int64[Tensor, " p"]) -> Self:
        """Group rows by their numbers."""
        ranked, order = numbers.sort(stable=True)
        return cls(order, torch.unique_consecutive(ranked, return_counts=True)[1])

    def sums(self, rows: Float64[Tensor, "p c"]) -> Float64[Tensor, "g c"]:
        """The sum of the rows of each group."""
        return sums_of(rows[self.order], self.counts)

    @property
    def first(self) -> Int64[Tensor, " g"]:
        """The first row of each group."""
        return self.order[self.counts.cumsum(0) - self.counts]

    @property
    def owner(self) -> Int64[Tensor, " p"]:
        """The group of each row."""
        groups = torch.arange(len(self.counts), device=self.order.device)
        ranked = groups.repeat_interleave(self.counts, output_size=len(self.order))
        return torch.empty_like(self.order).index_copy_(0, self.order, ranked)


def sums_of(rows: Float64[Tensor, "p c"], counts: Int64[Tensor, " g"]) -> Float64[Tensor, "g c"]:
    """Sums of the first rows, of the next ones, …: as many as the counts say, one after the other."""
    if not len(rows):
        return rows.new_zeros(len(counts), rows.shape[1])
    return torch.segment_reduce(rows, "sum", lengths=counts, axis=0, unsafe=True)  # unchecked: nobody waits


def by_cubes(
    places: Float64[Tensor, "p 3"], side_m: float
) -> Iterator[tuple[Int64[Tensor, " k"], Float64[Tensor, "c 3"], Int64[Tensor, " k"]]]:
    """Some places at a time: their rows, the middles, m, of the cubes of space in which they lie, and the cube of each.

    What is asked of a cube's middle instead of each place in it is asked less often, and does not depend on which
    other places there are.
    """
    cubes = (places / side_m).floor()
    numbers = numbered(cubes.long())
    for rows in numbers.argsort(stable=True).split(_AT_ONCE if on_cpu(places) else _AT_ONCE_ELSEWHERE):
        _, cube, counts = torch.unique_consecutive(numbers[rows], return_inverse=True, return_counts=True)
        yield rows, (cubes[rows[counts.cumsum(0) - counts]] + 0.5) * side_m, cube
