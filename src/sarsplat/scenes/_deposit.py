"""From point deposits of cross-section to β⁰ at the pixel centres, seen through the system's power response."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_matrix

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Response, variance_of, width_of


class Deposit:
    """Cross-section collected on nodes finer than the pixels, `oversample` per pixel and axis; pixel centres are nodes.

    `image` is β⁰ of everything added so far, float64 [rows, columns], seen through the grid's response.
    """

    def __init__(self, grid: ImageGrid, oversample: int) -> None:
        if oversample < 1 or oversample != int(oversample):
            raise SarsplatError(f"oversample {oversample} must be a whole number of at least 1")
        self._columns = _Axis(grid.azimuth_m, grid.spacing_m[0] / oversample, grid.resolution_m[0], grid.response)
        self._rows = _Axis(grid.range_m, grid.spacing_m[1] / oversample, grid.resolution_m[1], grid.response)
        self.image = np.zeros((grid.rows, grid.columns))

    @property
    def azimuth_reach(self) -> tuple[float, float]:
        """First and last azimuth that reach the image, m."""
        return self._columns.first, self._columns.first + (self._columns.count - 1) * self._columns.step

    def add(
        self,
        azimuth: Float64[np.ndarray, " hits"],
        slant_range: Float64[np.ndarray, " hits"],
        cross_section: Float64[np.ndarray, " hits"],
    ) -> None:
        """Add cross-sections (m², of either sign) at positions (m)."""
        # Bilinear sharing between four nodes keeps the centre of gravity: rays and nodes do not beat into moiré.
        rows, columns = self._rows, self._columns
        v, u = (slant_range - rows.first) / rows.step, (azimuth - columns.first) / columns.step
        near = (v >= 0) & (v < rows.count - 1) & (u >= 0) & (u < columns.count - 1)
        v, u, weight = v[near], u[near], cross_section[near]
        row, column = v.astype(np.int32), u.astype(np.int32)
        fv, fu = v - row, u - column
        shares = np.concatenate([weight * a * b for a in (1 - fv, fv) for b in (1 - fu, fu)])
        places = np.concatenate([row, row, row + 1, row + 1]), np.concatenate([column, column + 1, column, column + 1])
        nodes = coo_matrix((shares, places), shape=(rows.count, columns.count)).tocsr()
        self.image += rows.response @ (nodes @ columns.response.T)


class _Axis:
    """Nodes along one image axis, and the response from nodes to pixels."""

    def __init__(
        self, centers: Float64[np.ndarray, " pixels"], step: float, resolution: float, response: Response
    ) -> None:
        if step > resolution / 2:
            raise SarsplatError(
                f"a resolution of {resolution:.3g} m is too fine for image nodes {step:.3g} m apart; use smaller "
                f"pixels or a resolution of at least {2 * step:.3g} m (in Python, a larger oversample works too)"
            )
        # Bilinear sharing widens a point by step²/6 on average; the response is narrowed by as much.
        variance = variance_of(resolution) - step**2 / 6
        margin = math.ceil(response.reach * width_of(variance) / step)
        self.step = step
        self.first = centers[0] - margin * step
        self.count = round((centers[-1] - centers[0]) / step) + 2 * margin + 1
        offset = centers[:, None] - (self.first + step * np.arange(self.count))
        self.response = response.density(offset, variance)  # [pixels, nodes], 1/m
