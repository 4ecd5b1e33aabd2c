"""Thinning: one point, their mean, for all points in a cube."""

from __future__ import annotations

import torch
from jaxtyping import Float64
from torch import Tensor

from sarsplat.surface.cells import Groups, numbered

AT_ONCE = 1 << 22
"""Points that wait to be thinned."""


class Voxels:
    """Sums of points in cubes of a side, m, on the device of the points."""

    def __init__(self, side_m: float, device: torch.device | str = "cpu") -> None:
        self._side_m = side_m
        self._cells = torch.empty(0, 3, dtype=torch.int64, device=device)
        self._sums = torch.empty(0, 4, dtype=torch.float64, device=device)  # and how many
        self._waiting: list[Float64[Tensor, "p 3"]] = []

    def add(self, points: Float64[Tensor, "p 3"]) -> None:
        """Count these points."""
        self._waiting.append(points)
        if sum(map(len, self._waiting)) > AT_ONCE:
            self._merge()

    def means(self) -> Float64[Tensor, "v 3"]:
        """The mean of the points in each cube that has any."""
        self._merge()
        return self._sums[:, :3] / self._sums[:, 3:]

    def _merge(self) -> None:
        points, self._waiting = torch.cat([self._sums[:0, :3], *self._waiting]), []
        self._sums = torch.cat([self._sums, torch.cat([points, torch.ones_like(points[:, :1])], dim=1)])
        places = torch.cat([self._cells, (points / self._side_m).floor().long()])
        groups = Groups.of(numbered(places))
        self._cells, self._sums = places[groups.first], groups.sums(self._sums)
