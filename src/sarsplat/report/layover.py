"""The vertical slice through the brightest layover of a stack, for the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from sarsplat.geometry import ImageGrid, Stack, View

if TYPE_CHECKING:
    import trimesh

    from sarsplat.data import Dataset

Points = Float[np.ndarray, "p 3"]


@dataclass(frozen=True)
class Slice:
    """A vertical slice along the line of sight of a view: all azimuths within half a thickness of one, m."""

    view: View
    azimuth_m: float
    thickness_m: float

    def axes(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """Ground range, growing away from the radar, and height of points, m."""
        return points[:, :2] @ self.view.look.ahead, points[:, 2]

    def within(self, points: Points) -> Bool[np.ndarray, " p"]:
        """Which points are in the slice."""
        return np.abs(points @ self.view.look.gradients[0] - self.azimuth_m) <= self.thickness_m / 2

    def through(self, mesh: trimesh.Trimesh) -> Float[np.ndarray, "lines 2 3"]:
        """Line segments where the slice's middle plane cuts a mesh, m."""
        from trimesh.intersections import mesh_plane

        across = self.view.look.gradients[0]
        return np.asarray(mesh_plane(mesh, across, self.azimuth_m * across), dtype=np.float64).reshape(-1, 2, 3)


def brightest_layover(dataset: Dataset, points: Points, window: int) -> tuple[int, Slice]:
    """Index of a training image, and the slice through its brightest layover, `window` pixels thick.

    Layover is where points that share a pixel are farther apart in elevation than the stack resolves. Without any, the
    slice is through what is brightest.
    """
    found = []
    for index, (entry, power) in enumerate(zip(dataset.entries, dataset.power, strict=True)):
        if entry.split == "train" and entry.stack is not None:
            several = _several_heights(points, entry.view, entry.stack, dataset.grid)
            shown = np.where(several, power, 0) if several.any() else power
            sums = uniform_filter1d(shown.sum(0, dtype=np.float64), window, mode="constant")
            found.append((bool(several.any()), float(sums.max()), index, int(sums.argmax())))
    _, _, index, column = max(found)
    azimuth_m, width_m = float(dataset.grid.azimuth_m[column]), dataset.grid.spacing_m[0]
    return index, Slice(dataset.views[index], azimuth_m, window * width_m)


def _several_heights(
    points: Points, view: View, stack: Stack, grid: ImageGrid
) -> Bool[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Pixels that hold points whose elevations differ by more than the stack resolves."""
    across, elevation, slant = view.look.frame @ points.T
    column, row = (
        np.rint((places - centres[0]) / spacing).astype(int)
        for places, centres, spacing in zip(
            (across, slant), (grid.azimuth_m, grid.range_m), grid.spacing_m, strict=True
        )
    )
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    pixels = row[inside], column[inside]
    low, high = np.full((grid.rows, grid.columns), np.inf), np.full((grid.rows, grid.columns), -np.inf)
    np.minimum.at(low, pixels, elevation[inside])
    np.maximum.at(high, pixels, elevation[inside])
    return high - low > stack.resolution_m
