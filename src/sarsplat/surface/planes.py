"""The plane through the weighted mean of the points around a place: what a mesh is the zero surface of."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64, Real
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.surface import cells
from sarsplat.surface.neighbours import Neighbours
from sarsplat.uninterruptible import uninterruptible

_SPACINGS = 7.5  # of the points, in a unit at least: nothing is farther from the next one than the mesh reaches
_SMOOTHING = 0.25  # standard deviation of the points' weights, units
_NEIGHBOURS = 24  # points that count for a place
_AT_ONCE = 50_000  # places whose points are searched
_SUMMED = 4096  # places whose points are summed: what is calculated of them stays in the processor's cache
_ASKED = 10_000  # points, at most, how far the next one is


@dataclass(frozen=True)
class Planes(ABC):
    """The planes around places."""

    points: Float64[np.ndarray, "p 3"]
    """m."""
    unit_m: float
    """A resolution cell, or more where points are so far apart that smaller ones would fall between them."""

    @abstractmethod
    def at(self, places: Real[np.ndarray, "q 3"]) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        """Signed distances of places from their planes, m, and the planes' unit normals."""

    @abstractmethod
    def apart(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        """Distances of places from the nearest point, m."""


def planes_through(
    points: Float64[np.ndarray, "p 3"], normals: Real[np.ndarray, "p 3"], cell_m: float, device: torch.device
) -> Planes:
    """The planes through oriented points, calculated on a device."""
    there, some = torch.from_numpy(points).to(device), slice(None, None, math.ceil(len(points) / _ASKED))
    if not cells.on_cpu(there):
        near = Neighbours(there)
        apart = near.nearest(there[some], 2)[0][:, 1].sqrt() if len(points) > 1 else there.new_zeros(1)
        unit_m = max(cell_m, _SPACINGS * float(apart.quantile(0.5)))
        return _OnDevice(points, unit_m, torch.cat([there, torch.from_numpy(normals).to(there)], dim=1), near)
    tree = cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)  # the fastest to make and ask
    spacing_m = float(np.median(tree.query(points[some], k=[2], workers=-1)[0])) if len(points) > 1 else 0.0
    return _OnCpu(points, max(cell_m, _SPACINGS * spacing_m), np.concatenate([points, normals], axis=1), tree)


@dataclass(frozen=True)
class _OnCpu(Planes):
    """With scipy's trees."""

    oriented: Float64[np.ndarray, "p 6"]
    """Points, m, and their normals."""
    tree: cKDTree

    def at(self, places: Real[np.ndarray, "q 3"]) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        distance, normal = np.empty(len(places)), np.empty((len(places), 3))
        count = np.arange(1, min(_NEIGHBOURS, len(self.oriented)) + 1)
        for part in some_at_a_time(len(places)):
            apart, index = uninterruptible(self.tree.query, places[part], k=count, workers=-1)
            for few in range(0, len(apart), _SUMMED):
                some = slice(few, few + _SUMMED)
                place, plane = self._means(apart[some], index[some])
                offset = places[part][some] - place
                distance[part][some], normal[part][some] = np.einsum("pc,pc->p", offset, plane), plane
        return distance, normal

    def _means(
        self, apart: Float64[np.ndarray, "q k"], index: Int64[np.ndarray, "q k"]
    ) -> tuple[Float64[np.ndarray, "q 3"], Float64[np.ndarray, "q 3"]]:
        """Weighted mean places and unit normals of points that are so far away, m."""
        weight = np.exp(-0.5 * (apart**2 - apart[:, :1] ** 2) / (_SMOOTHING * self.unit_m) ** 2)
        sums = np.zeros((len(apart), 6))
        for of, near in zip(weight.T.copy(), index.T.copy(), strict=True):  # one after the other: no large arrays
            sums += of[:, None] * self.oriented[near]
        length = np.linalg.norm(sums[:, 3:], axis=1, keepdims=True)
        # normals on both sides of a sheet may cancel
        return sums[:, :3] / weight.sum(1, keepdims=True), sums[:, 3:] / np.maximum(length, 1e-12)

    def apart(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        distance: Float64[np.ndarray, " q"] = uninterruptible(self.tree.query, places, workers=-1)[0]
        return distance


@dataclass(frozen=True)
class _OnDevice(Planes):
    """With what is for all devices."""

    oriented: Float64[Tensor, "p 6"]
    near: Neighbours

    def at(self, places: Real[np.ndarray, "q 3"]) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        found = [self.oriented.new_empty(0, 4)]
        for some in torch.from_numpy(places).to(self.oriented).split(_AT_ONCE):
            square, index = self.near.nearest(some, min(_NEIGHBOURS, len(self.oriented)))
            weight = torch.exp(-0.5 * (square - square[:, :1]) / (_SMOOTHING * self.unit_m) ** 2)[..., None]
            place, normal = ((weight * self.oriented[index]).sum(1) / weight.sum(1)).split(3, dim=1)
            # normals on both sides of a sheet may cancel
            plane = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-12)
            found.append(torch.cat([((some - place) * plane).sum(1, keepdim=True), plane], dim=1))
        both = torch.cat(found).cpu().numpy()
        return both[:, 0], both[:, 1:]

    def apart(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        return self.near.nearest(torch.from_numpy(places).to(self.oriented), 1)[0][:, 0].sqrt().cpu().numpy()


def some_at_a_time(count: int) -> Iterator[slice]:
    """Chunks of the places, to bound memory."""
    return (slice(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE))
