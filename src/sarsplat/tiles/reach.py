"""Bounding boxes of footprints on the two planes of a view, by which a tile finds the Gaussians that it needs."""

from __future__ import annotations

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
from sarsplat.renderer.footprints import deviations

_AT_A_TIME = 1 << 18  # Gaussians that are projected at once: their footprints are not kept


@dataclass(frozen=True)
class Window:
    """A rectangle of a plane, m."""

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def area(self) -> float:
        return math.prod(max(0.0, high - low) for low, high in zip(self.low, self.high, strict=True))

    def joined(self, other: Window) -> Window:
        low = (min(self.low[0], other.low[0]), min(self.low[1], other.low[1]))
        return Window(low, (max(self.high[0], other.high[0]), max(self.high[1], other.high[1])))


NOWHERE = Window((math.inf, math.inf), (-math.inf, -math.inf))
"""What overlaps nothing."""


@dataclass(frozen=True)
class Boxes:
    """Rectangles around footprints on one plane, a point of its lattice wider than they are."""

    low: Float[Tensor, "2 n"]
    high: Float[Tensor, "2 n"]
    """Corners, m; what touches nothing has its low one above its high one."""

    def overlapping(self, window: Window) -> Int64[Tensor, " k"]:
        inside = torch.ones_like(self.low[0], dtype=torch.bool)
        for low, high, begin, end in zip(self.low, self.high, window.low, window.high, strict=True):
            inside &= (low <= end) & (high >= begin)
        return inside.nonzero()[:, 0]

    def of(self, index: Int64[Tensor, " k"]) -> Boxes:
        return Boxes(self.low[:, index], self.high[:, index])

    @property
    def window(self) -> Window:
        if not self.low.shape[1]:
            return NOWHERE
        (left, below), (right, above) = self.low.amin(1).tolist(), self.high.amax(1).tolist()
        return Window((left, below), (right, above))


@dataclass(frozen=True)
class Reach:
    """Boxes of a scene's Gaussians seen from one direction: on the ray lattice and in the image."""

    on_rays: Boxes
    in_image: Boxes

    def some(self, index: Int64[Tensor, " k"]) -> Reach:
        return Reach(self.on_rays.of(index), self.in_image.of(index))

    @classmethod
    def of(
        cls, gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, shift: Float[Tensor, "1 2"] | None
    ) -> Reach:
        count = len(gaussians)
        sides = torch.empty(2, 4, count, device=gaussians.means.device)
        with stage("where Gaussians reach", count) as reporter:
            for first in range(0, count, _AT_A_TIME):
                some = slice(first, first + _AT_A_TIME)
                p = project(rows_of(gaussians, some), [view], grid, rays=rays, shift=shift)
                depth = p.optical_depth[0]
                radius = (2 * (depth / MIN_RAY_DEPTH).log()).clamp(min=0).sqrt()
                radius = radius.masked_fill(depth < MIN_RAY_DEPTH, -math.inf)  # it touches no ray
                sides[0, :, some] = _around(p.rays, radius[:, None], rays.spacing_m)
                sides[1, :, some] = _around(p.pixels, math.sqrt(IMAGE_CUT), grid.spacing_m)
                reporter.advance(len(depth))
        return cls(*(Boxes(side[:2], side[2:]) for side in sides))


def rows_of(gaussians: Gaussians, rows: slice | Int64[Tensor, " k"]) -> Gaussians:
    """`gaussians[rows]`, in time that depends on the number of rows alone."""
    return gaussians.with_tensors(**{name: tensor[rows] for name, tensor in gaussians.tensors().items()})


def _around(
    footprints: Footprints, radius: float | Float[Tensor, "n 1"], spacing_m: tuple[float, float]
) -> Float[Tensor, "4 n"]:
    """Boxes of footprints that end at so many standard deviations: low corners, then high ones."""
    centers, half = footprints.centers[0], radius * deviations(footprints.roots[0])
    half = half + torch.tensor(spacing_m, dtype=half.dtype, device=half.device)
    return torch.cat([centers - half, centers + half], dim=1).T
