"""Planes of the pieces of surface around a place, weighted: what a mesh is the zero surface of.

After A. C. Öztireli, G. Guennebaud and M. Gross, "Feature preserving point set surfaces based on non-linear kernel
regression", Computer Graphics Forum 2009: pieces whose normals differ from the mean count less each time the mean is
taken, so that edges stay.
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
from sarsplat.surface.neighbours import Neighbours, Tree, neighbours_of
from sarsplat.surface.surfels import CUBE, Surfels, dot

_SPACINGS = 7.5  # of the points, in a unit at least: nothing is farther from the next one than the mesh reaches
_SMOOTHING = 0.25  # standard deviation of the pieces' weights, units
_NEIGHBOURS = 32  # pieces that count for a place
_ROUNDS = 2
_UNLIKE = 0.5  # distance between unit normals at which a piece counts e⁻¹ of one whose normal is the mean
_AT_ONCE = 50_000  # places for which points are searched
_SUMMED = 4096  # places whose pieces are summed on the CPU: what is calculated of them stays in the processor's cache
_ASKED = 10_000  # points, at most, how far the next one is


@dataclass(frozen=True)
class Planes:
    """The planes around places."""

    points: Float64[np.ndarray, "p 3"]
    """m."""
    unit_m: float
    """A resolution cell, or more where points are so far apart that smaller ones would fall between them."""
    _near: Tree | Neighbours
    _pieces: Surfels
    _near_pieces: Tree | Neighbours

    @classmethod
    def through(
        cls,
        points: Float64[np.ndarray, "p 3"],
        normals: Real[np.ndarray, "p 3"],
        cell_m: float,
        device: torch.device,
    ) -> Planes:
        """The planes through oriented points, calculated on a device."""
        there, some = torch.from_numpy(points).to(device), slice(None, None, math.ceil(len(points) / _ASKED))
        near = neighbours_of(there)
        apart = near.nearest(there[some], 2)[0][:, 1].sqrt() if len(points) > 1 else there.new_zeros(1)
        unit_m = max(cell_m, _SPACINGS * float(apart.quantile(0.5)))
        pieces = Surfels.of(there, torch.from_numpy(normals).to(there), CUBE * unit_m)
        return cls(points, unit_m, near, pieces, neighbours_of(pieces.places))

    def at(
        self, places: Real[np.ndarray, "q 3"], sides: Real[np.ndarray, "q 3"] | None = None
    ) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        """Signed distances of places from their planes, m, and the planes' unit normals.

        Of pieces that differ, those like most of them count, or those whose normals are like `sides`.
        """
        found = [np.empty((0, 4))]
        at_once = _SUMMED if cells.on_cpu(self._pieces.places) else _AT_ONCE
        for first in range(0, len(places), at_once):
            some = slice(first, first + at_once)
            there = torch.from_numpy(places[some]).to(self._pieces.places)
            side = None if sides is None else torch.from_numpy(sides[some]).to(there)
            found.append(self._at(there, side).cpu().numpy())
        both = np.concatenate(found)
        return both[:, 0], both[:, 1:]

    def _at(self, places: Float64[Tensor, "q 3"], side: Float64[Tensor, "q 3"] | None) -> Float64[Tensor, "q 4"]:
        square, index = self._near_pieces.nearest(places, min(_NEIGHBOURS, len(self._pieces.places)))
        normals, counts = self._pieces.normals[index], self._pieces.counts[index]
        offsets = dot(places[:, None] - self._pieces.places[index], normals)
        near = counts * torch.exp(-0.5 * (square - square[:, :1]) / (_SMOOTHING * self.unit_m) ** 2)
        weight = near
        mean = normalize((near[:, None] @ normals)[:, 0], dim=1) if side is None else side
        for _ in range(_ROUNDS):
            apart = 2 - 2 * dot(normals, mean[:, None])
            # relative to the most alike: some always count
            weight = near * torch.exp((apart.amin(1, keepdim=True) - apart) / _UNLIKE**2)
            mean = normalize((weight[:, None] @ normals)[:, 0], dim=1)
        distance = (weight * offsets).sum(1) / weight.sum(1)
        return torch.cat([distance[:, None], mean], dim=1)

    def apart(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        """Distances of places from the nearest point, m."""
        there = torch.from_numpy(places).to(self._pieces.places)
        return self._near.nearest(there, 1)[0][:, 0].sqrt().cpu().numpy()


def some_at_a_time(count: int) -> Iterator[slice]:
    """Chunks of places, to bound memory."""
    return (slice(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE))
