"""Deposition of cross-sections on a grid finer than the pixels, and their convolution with the power response to β⁰."""

import math

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csr_matrix

from sarsplat.arguments import check_number
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Response, variance_of, width_of


class NodeGrid:
    """Grid of `oversample` nodes per pixel and axis, pixel centres included, with the response from nodes to pixels."""

    def __init__(self, grid: ImageGrid, oversample: int) -> None:
        check_number("oversample", oversample, 1)
        width, depth = grid.spacing_m
        self.columns = _Axis(grid.azimuth_m, width / oversample, grid.resolution_m[0], grid.response, oversample)
        self.rows = _Axis(grid.range_m, depth / oversample, grid.resolution_m[1], grid.response, oversample)


class Deposit:
    """Cross-section collected on nodes; `image` is β⁰ of everything added so far, float64 [rows, columns]."""

    def __init__(self, nodes: NodeGrid) -> None:
        self._rows, self._columns = nodes.rows, nodes.columns
        self.image = np.zeros((self._rows.pixels, self._columns.pixels))

    def add(
        self,
        azimuth: Float64[np.ndarray, " hits"],
        slant_range: Float64[np.ndarray, " hits"],
        cross_section: Float64[np.ndarray, " hits"],
    ) -> None:
        """Add cross-sections (m², of either sign) at positions (m); nearby positions are fastest."""
        # Bilinear sharing between four nodes keeps the centre of gravity: rays and nodes do not beat into moiré.
        rows, columns = self._rows, self._columns
        v, u = (slant_range - rows.first) / rows.step, (azimuth - columns.first) / columns.step
        near = (v >= 0) & (v < rows.count - 1) & (u >= 0) & (u < columns.count - 1)
        if not near.any():
            return
        if not near.all():
            v, u, cross_section = v[near], u[near], cross_section[near]
        row, column = v.astype(np.int64), u.astype(np.int64)
        v -= row
        u -= column
        top, left = int(row.min()), int(column.min())
        height, width = int(row.max()) + 2 - top, int(column.max()) + 2 - left
        node = (row - top) * width + (column - left)
        far = cross_section * v
        nearer = cross_section - far
        far_right, near_right = far * u, nearer * u
        shares = np.concatenate([nearer - near_right, near_right, far - far_right, far_right])
        corners = np.concatenate([node, node + 1, node + width, node + width + 1])
        nodes = np.bincount(corners, shares, minlength=height * width).reshape(height, width)
        row_pixels, row_response = rows.near(top, height)
        column_pixels, column_response = columns.near(left, width)
        self.image[row_pixels, column_pixels] += (column_response @ (row_response @ nodes).T).T


class _Axis:
    """Nodes along one image axis, and the response from nodes to pixels."""

    def __init__(
        self,
        centers: Float64[np.ndarray, " pixels"],
        step: float,
        resolution: float,
        response: Response,
        oversample: int,
    ) -> None:
        if step > resolution / 2:
            raise SarsplatError(
                f"a resolution of {resolution:.3g} m is too fine for image nodes {step:.3g} m apart; use smaller "
                f"pixels or a resolution of at least {2 * step:.3g} m (in Python, a larger oversample works too)"
            )
        # Bilinear sharing widens a point by step²/6 on average; the response is narrowed by as much.
        variance = variance_of(resolution) - step**2 / 6
        self._margin = math.ceil(response.reach * width_of(variance) / step)
        self._oversample = oversample
        self.step, self.pixels = step, len(centers)
        self.first = float(centers[0]) - self._margin * step
        self.count = (len(centers) - 1) * oversample + 2 * self._margin + 1
        self._taps = response.density(step * np.arange(-self._margin, self._margin + 1), variance)  # 1/m

    @property
    def reach(self) -> tuple[float, float]:
        """First and last position that contributes to the image, m."""
        return self.first, self.first + (self.count - 1) * self.step

    def near(self, first: int, count: int) -> tuple[slice, csr_matrix]:
        """Return the pixels within reach of `count` nodes from `first`, and the response [pixels, nodes], 1/m."""
        begin = max(0, -((2 * self._margin - first) // self._oversample))
        end = min(self.pixels, (first + count - 1) // self._oversample + 1)
        pixel = np.arange(begin, max(begin, end))
        node = pixel[:, None] * self._oversample + np.arange(len(self._taps)) - first
        inside = (node >= 0) & (node < count)
        taps = np.broadcast_to(self._taps, node.shape)[inside]
        starts = np.concatenate([[0], np.cumsum(inside.sum(axis=1))])
        return slice(begin, begin + len(pixel)), csr_matrix((taps, node[inside], starts), shape=(len(pixel), count))
