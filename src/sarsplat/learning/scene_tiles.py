"""Tiles of a scene: which Gaussians belong to each, and snapshots of trainings with some of theirs, or those of all."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sarsplat.learning.snapshot import Snapshot


@dataclass(frozen=True)
class Tile:
    """A rectangle on the ground; those at the edge of the scene have no end there."""

    low: tuple[float, float]
    high: tuple[float, float]
    """Its corners (x, y), m; the upper ones are the next tile's."""

    def holds(self, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which of these centres are its own."""
        places = means.detach()[:, :2]
        return ((places >= places.new_tensor(self.low)) & (places < places.new_tensor(self.high))).all(1)


def tiles_of(means: Float[Tensor, "n 3"], side: int) -> list[Tile]:
    """`side` × `side` tiles with the same number of these centres in each, but for what cannot be divided."""
    every = Tile((-math.inf, -math.inf), (math.inf, math.inf))
    return [tile for slab in _cut(every, means, side, 0) for tile in _cut(slab, means, side, 1)]


def _cut(tile: Tile, means: Float[Tensor, "n 3"], parts: int, axis: int) -> list[Tile]:
    """Parts of a tile along an axis; fewer where too few centres are at different places."""
    places = means.detach().cpu()[tile.holds(means).cpu()][:, axis].sort().values
    inner = [float(places[len(places) * k // parts]) for k in range(1, parts)]
    edges = [tile.low[axis], *sorted({edge for edge in inner if edge > float(places[0])}), tile.high[axis]]
    along = [((low, tile.low[1]), (high, tile.high[1])) for low, high in pairwise(edges)]
    if axis == 1:
        along = [((tile.low[0], low), (tile.high[0], high)) for low, high in pairwise(edges)]
    return [Tile(low, high) for low, high in along]


def with_some(snapshot: Snapshot, rows: Collection[str], which: Bool[Tensor, " n"]) -> Snapshot:
    """A training with some of its Gaussians; `rows` are the parameters with a row for each."""
    chosen = which.cpu().nonzero()[:, 0]
    some = {name: tensor[chosen] for name, tensor in snapshot.tensors.items() if _of_rows(name, rows)}
    return replace(snapshot, tensors=snapshot.tensors | some)


def merged(parts: Sequence[Snapshot], rows: Collection[str], seconds: float) -> Snapshot:
    """A training with the Gaussians of all; what is not of single ones is the same in them, but for chance."""
    first = parts[0]
    joined = {name: torch.cat([part.tensors[name] for part in parts]) for name in first.tensors if _of_rows(name, rows)}
    return replace(first, seconds=seconds, tensors=first.tensors | joined)


def _of_rows(name: str, rows: Collection[str]) -> bool:
    """Whether a tensor of a snapshot has a row for each Gaussian."""
    kind, _, which = name.partition("/")
    return kind in ("model", "optimiser") and which.partition("/")[0] in rows
