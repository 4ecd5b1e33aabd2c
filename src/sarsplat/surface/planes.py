"""Signed distance to the weighted planes of the surfels around a place; the mesh is its zero surface.

After A. C. Öztireli, G. Guennebaud and M. Gross, "Feature preserving point set surfaces based on non-linear kernel
regression", Computer Graphics Forum 2009: surfels whose normals differ from the mean lose weight in each round, so that
edges stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Real
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.surface import cells
from sarsplat.surface.cells import CUBE, Surfels, dot
from sarsplat.surface.neighbours import Neighbours, Tree, neighbours_of

_SPACINGS = 7.5  # minimum of the unit, spacings of the points, so that the mesh has no holes between them
_SMOOTHING = 0.25  # standard deviation of the surfels' weights, units
_NEIGHBOURS = 32  # surfels that count for a place
_ROUNDS = 2
_UNLIKE = 0.5  # distance of unit normals from the mean at which a surfel's weight is 1/e
_AT_ONCE = 50_000  # places in a batch
_SUMMED = 4096  # places in a batch on the CPU, for its caches
_ASKED = 10_000  # maximum number of points whose nearest neighbour gives the spacing


@dataclass(frozen=True)
class Planes:
    """Planes of oriented points."""

    points: Float64[np.ndarray, "p 3"]
    """Points, m."""
    unit_m: float
    """Unit of lengths, m: a resolution cell, or more for sparse points."""
    _near: Tree | Neighbours
    _surfels: Surfels
    _near_surfels: Tree | Neighbours

    @classmethod
    def through(
        cls,
        points: Float64[np.ndarray, "p 3"],
        normals: Real[np.ndarray, "p 3"],
        cell_m: float,
        device: torch.device,
    ) -> Planes:
        """Planes through oriented points, calculated on a device."""
        cloud, sample = torch.from_numpy(points).to(device), slice(None, None, math.ceil(len(points) / _ASKED))
        near = neighbours_of(cloud)
        spacing = near.nearest(cloud[sample], 2)[0][:, 1].sqrt() if len(points) > 1 else cloud.new_zeros(1)
        unit_m = max(cell_m, _SPACINGS * float(spacing.quantile(0.5)))
        surfels = Surfels.of(cloud, torch.from_numpy(normals).to(cloud), CUBE * unit_m)
        return cls(points, unit_m, near, surfels, neighbours_of(surfels.places))

    def at(
        self, places: Real[np.ndarray, "q 3"], sides: Real[np.ndarray, "q 3"] | None = None
    ) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        """Signed distances of places from their planes, m, and the planes' unit normals.

        Surfels with normals like the majority, or like `sides` if given, count most.
        """
        results = [np.empty((0, 4))]
        count = _SUMMED if cells.on_cpu(self._surfels.places) else _AT_ONCE
        for first in range(0, len(places), count):
            batch = slice(first, first + count)
            place = torch.from_numpy(places[batch]).to(self._surfels.places)
            side = None if sides is None else torch.from_numpy(sides[batch]).to(place)
            results.append(self._at(place, side).cpu().numpy())
        both = np.concatenate(results)
        return both[:, 0], both[:, 1:]

    def _at(self, places: Float64[Tensor, "q 3"], side: Float64[Tensor, "q 3"] | None) -> Float64[Tensor, "q 4"]:
        square, index = self._near_surfels.nearest(places, min(_NEIGHBOURS, len(self._surfels.places)))
        normals, counts = self._surfels.normals[index], self._surfels.counts[index]
        offsets = dot(places[:, None] - self._surfels.places[index], normals)
        near = counts * torch.exp(-0.5 * (square - square[:, :1]) / (_SMOOTHING * self.unit_m) ** 2)
        weight = near
        mean = normalize((near[:, None] @ normals)[:, 0], dim=1) if side is None else side
        for _ in range(_ROUNDS):
            difference = 2 - 2 * dot(normals, mean[:, None])  # squared
            # relative to the smallest, so that weights never vanish
            weight = near * torch.exp((difference.amin(1, keepdim=True) - difference) / _UNLIKE**2)
            mean = normalize((weight[:, None] @ normals)[:, 0], dim=1)
        distance = (weight * offsets).sum(1) / weight.sum(1)
        return torch.cat([distance[:, None], mean], dim=1)

    def distance_m(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        """Distances of places from the nearest point, m."""
        place = torch.from_numpy(places).to(self._surfels.places)
        return self._near.nearest(place, 1)[0][:, 0].sqrt().cpu().numpy()


def batches(count: int) -> Iterator[slice]:
    """Batches of places, to bound memory."""
    return (slice(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE))
