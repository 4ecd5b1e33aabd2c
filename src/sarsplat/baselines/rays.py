"""Samples of SAR-NeRF: azimuth × rays in elevation × range (docs/concepts/baselines-sar-nerf.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.geometry import ImageGrid, View


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one view through a box."""

    turn: Float64[np.ndarray, "3 3"]
    """Rotation from the world to the radar frame."""
    azimuth_m: Float64[np.ndarray, " a"]
    range_m: Float64[np.ndarray, " r"]
    """Centres of the sampled columns (`azimuth_m`) and rows (`range_m`), m."""
    first_column: int
    first_row: int
    """Column and row of the first sampled pixel."""
    elevation_m: tuple[float, float]
    """Limits of the box in elevation (across the line of sight), m."""
    count: int
    """Number of rays per column, one in each of as many strata of equal width."""

    @classmethod
    def through(
        cls,
        view: View,
        grid: ImageGrid,
        low_m: Float64[np.ndarray, " 3"],
        high_m: Float64[np.ndarray, " 3"],
        count: int,
        *,
        whole: bool,
    ) -> Rays:
        """Rays through a box; `whole` samples all pixels of the grid, else only those that show the box."""
        turn = view.look.frame
        middle, half = turn @ (low_m + high_m) / 2, np.abs(turn) @ (high_m - low_m) / 2
        columns = slice(0, grid.columns) if whole else _within(grid.azimuth_m, grid.spacing_m[0], middle[0], half[0])
        rows = slice(0, grid.rows) if whole else _within(grid.range_m, grid.spacing_m[1], middle[2], half[2])
        edges = float(middle[1] - half[1]), float(middle[1] + half[1])
        return cls(turn, grid.azimuth_m[columns], grid.range_m[rows], columns.start, rows.start, edges, count)

    @property
    def spacing_m(self) -> float:
        """Width of a stratum, m: the share of the elevation that one ray stands for."""
        return (self.elevation_m[1] - self.elevation_m[0]) / self.count

    def offsets(self, generator: torch.Generator | None) -> Float64[Tensor, "a {self.count}"]:
        """Elevation of every ray, m, float64 [A, K]: random in its stratum, or without generator the middle of it."""
        within = torch.full((len(self.azimuth_m), self.count), 0.5, dtype=torch.float64)
        if generator is not None:
            within = torch.rand(within.shape, dtype=torch.float64, generator=generator)
        return self.elevation_m[0] + (torch.arange(self.count) + within) * self.spacing_m

    def places(
        self, offsets: Float64[Tensor, "a k"], columns: slice, like: Tensor
    ) -> Float[Tensor, "c k {len(self.range_m)} 3"]:
        """Sampled places of a slice of columns, world frame, m, near to far, with dtype and device of `like`."""
        elevation = offsets[columns].to(like)
        azimuth = torch.from_numpy(self.azimuth_m[columns]).to(like)
        along = torch.from_numpy(self.range_m).to(like)
        x, y, z = torch.from_numpy(self.turn).to(like).unbind(0)
        return azimuth[:, None, None, None] * x + elevation[:, :, None, None] * y + along[:, None] * z


def _within(centres: Float64[np.ndarray, " n"], spacing: float, middle: float, half: float) -> slice:
    """Slice of the pixels that overlap middle ± half."""
    pixels = np.flatnonzero(np.abs(centres - middle) < half + spacing / 2)
    return slice(int(pixels[0]), int(pixels[-1]) + 1) if len(pixels) else slice(0, 0)
