"""Halos of Gaussians: bounding boxes of their footprints on the two planes of a view, to find those of a tile."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.progress import stage
from sarsplat.renderer import Footprints, project
from sarsplat.renderer.constants import IMAGE_CUT, MIN_RAY_DEPTH
from sarsplat.renderer.rendering import deviations

_BATCH = 1 << 18  # Gaussians that are projected at once, to bound memory


@dataclass(frozen=True)
class Window:
    """Rectangle of a plane, m."""

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def area(self) -> float:
        return math.prod(max(0.0, high - low) for low, high in zip(self.low, self.high, strict=True))

    def joined(self, other: "Window") -> "Window":
        low = (min(self.low[0], other.low[0]), min(self.low[1], other.low[1]))
        return Window(low, (max(self.high[0], other.high[0]), max(self.high[1], other.high[1])))


@dataclass(frozen=True)
class Boxes:
    """Rectangles around footprints on one plane, one lattice spacing wider on each side."""

    low: Float[Tensor, "2 n"]
    high: Float[Tensor, "2 n"]
    """Corners, m; an empty rectangle has low above high."""

    def overlapping(self, window: Window) -> Int64[Tensor, " k"]:
        """Indices of the boxes that overlap a window."""
        inside = torch.ones_like(self.low[0], dtype=torch.bool)
        for low, high, begin, end in zip(self.low, self.high, window.low, window.high, strict=True):
            inside &= (low <= end) & (high >= begin)
        return inside.nonzero()[:, 0]

    def of(self, index: Int64[Tensor, " k"]) -> "Boxes":
        return Boxes(self.low[:, index], self.high[:, index])

    @property
    def window(self) -> Window:
        if not self.low.shape[1]:
            return Window((math.inf, math.inf), (-math.inf, -math.inf))  # overlaps nothing
        (left, below), (right, above) = self.low.amin(1).tolist(), self.high.amax(1).tolist()
        return Window((left, below), (right, above))


@dataclass(frozen=True)
class Halos:
    """Boxes of a scene's Gaussians in one view: on the ray lattice and in the image."""

    on_rays: Boxes
    in_image: Boxes

    def of_rows(self, index: Int64[Tensor, " k"]) -> "Halos":
        return Halos(self.on_rays.of(index), self.in_image.of(index))

    @classmethod
    def of(
        cls, gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, shift: Float[Tensor, "1 2"] | None
    ) -> "Halos":
        count = len(gaussians)
        sides = torch.empty(2, 4, count, device=gaussians.means.device)
        with stage("where Gaussians reach", count) as reporter:
            for first in range(0, count, _BATCH):
                batch = slice(first, first + _BATCH)
                p = project(rows_of(gaussians, batch), [view], grid, rays=rays, shift=shift)
                depth = p.optical_depth[0]
                radius = (2 * (depth / MIN_RAY_DEPTH).log()).clamp(min=0).sqrt()
                radius = radius.masked_fill(depth < MIN_RAY_DEPTH, -math.inf)  # touches no ray
                sides[0, :, batch] = _around(p.rays, radius[:, None], rays.spacing_m)
                sides[1, :, batch] = _around(p.pixels, math.sqrt(IMAGE_CUT), grid.spacing_m)
                reporter.advance(len(depth))
        return cls(*(Boxes(side[:2], side[2:]) for side in sides))


def rows_of(gaussians: Gaussians, rows: slice | Int64[Tensor, " k"]) -> Gaussians:
    """`gaussians[rows]`, in time that only depends on the number of rows."""
    return gaussians.with_tensors(**{name: tensor[rows] for name, tensor in gaussians.tensors().items()})


def _around(
    footprints: Footprints, radius: float | Float[Tensor, "n 1"], spacing_m: tuple[float, float]
) -> Float[Tensor, "4 n"]:
    """Boxes of footprints cut at `radius` standard deviations: low corners, then high ones."""
    centers, half = footprints.centers[0], radius * deviations(footprints.roots[0])
    half = half + torch.tensor(spacing_m, dtype=half.dtype, device=half.device)
    return torch.cat([centers - half, centers + half], dim=1).T
