"""Soft rasterisation: coverage of the pixels of a plane by triangles, differentiable in their corners.

A triangle covers a pixel by c = sigmoid(±d²/σ): d is the distance from the pixel's centre to the triangle's outline,
the sign + inside and − outside; √σ is called the softness, m. Pairs of triangle and pixel are listed within boxes
around the triangles. Large numbers of pairs are computed in batches, and again in the backward pass.

Sums over pairs are `index_add` along one dimension, which adds in a fixed order on the CPU.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import logsigmoid
from torch.utils.checkpoint import checkpoint

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid

_LEAST_COVERAGE = 1e-4  # below which pairs are left out
_PAIRS_AT_ONCE = 1 << 18
_MOST_PAIRS = 1 << 27
_MOST_PIXELS = 1 << 20  # from the origin, on each axis


@dataclass(frozen=True)
class Lattice:
    """Pixels of a plane: first centre and spacing, both (across, along), and size."""

    first_m: tuple[float, float]
    step_m: tuple[float, float]
    columns: int
    rows: int

    @classmethod
    def of(cls, grid: ImageGrid) -> "Lattice":
        """Pixels of an image: azimuth across, slant range along."""
        return cls((float(grid.azimuth_m[0]), float(grid.range_m[0])), grid.spacing_m, grid.columns, grid.rows)

    @classmethod
    def around(cls, points: Float[Tensor, "n 2"], step_m: float) -> "Lattice":
        """Square pixels around points, at ((k + ½)·step, (l + ½)·step)."""
        low = torch.floor(points.detach().amin(0).double() / step_m).tolist()
        high = torch.floor(points.detach().amax(0).double() / step_m).tolist()
        if not all(abs(end) < _MOST_PIXELS for end in (*low, *high)):  # also catches inf and nan
            raise SarsplatError(
                f"a vertex of the mesh is {step_m * max(map(abs, (*low, *high))):.3g} m away; start again with a lower "
                "learning rate"
            )
        first_m = (low[0] + 0.5) * step_m, (low[1] + 0.5) * step_m
        return cls(first_m, (step_m, step_m), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)


@dataclass(frozen=True)
class Coverage:
    """Pairs of a triangle and a pixel near it, ordered by triangle."""

    face: Int64[Tensor, " p"]
    """Triangle of each pair."""
    pixel: Int64[Tensor, " p"]
    """Pixel of each pair, row · columns + column; `pixels` outside the lattice."""
    signed: Float[Tensor, " p"]
    """±d²/σ, whose sigmoid is the coverage."""
    faces: int
    pixels: int
    """Numbers of all triangles and pixels."""

    def shares(self) -> Float[Tensor, " p"]:
        """Coverage of each pair, relative to its triangle's sum over all pixels, also those outside the lattice."""
        return grouped_softmax(logsigmoid(self.signed), self.face, self.faces)

    def onto_pixels(self, values: Float[Tensor, " p"]) -> Float[Tensor, " pixels"]:
        return summed(values, self.pixel, self.pixels + 1)[:-1]

    def onto_faces(self, values: Float[Tensor, " p"]) -> Float[Tensor, " faces"]:
        return summed(values, self.face, self.faces)

    def union(self, opacity: Float[Tensor, " faces"] | None = None) -> Float[Tensor, " pixels"]:
        """1 − Π(1 − opacity·coverage) over the triangles at each pixel; opacity is 1 unless given."""
        if opacity is None:
            clear = logsigmoid(-self.signed)
        else:
            covered = torch.sigmoid(self.signed) * picked(opacity, self.face)
            clear = torch.log1p(-covered.clamp(max=1 - 1e-6))
        return -torch.expm1(self.onto_pixels(clear))


def soft_coverage(corners: Float[Tensor, "f 3 2"], lattice: Lattice, softness_m: float) -> Coverage:
    """Soft coverage of the pixels of a lattice by triangles (corners in m, in either order); √σ is the softness.

    Differentiable in `corners`. Triangles whose box does not touch the lattice have no pairs; pairs farther outside the
    lattice than its own size are dropped. Raises for non-finite corners and for too many pairs.
    """
    face, column, row, counts = _pairs(corners.detach(), lattice, softness_m)
    outside = (column < 0) | (column >= lattice.columns) | (row < 0) | (row >= lattice.rows)
    pixels = lattice.rows * lattice.columns
    pixel = torch.where(outside, pixels, row * lattice.columns + column)
    across = column.to(corners.dtype) * lattice.step_m[0] + lattice.first_m[0]
    along = row.to(corners.dtype) * lattice.step_m[1] + lattice.first_m[1]
    flat = corners.reshape(-1, 6).T.contiguous()  # a row for each coordinate
    if len(face) <= _PAIRS_AT_ONCE:
        signed = _signed(flat, face, across, along, softness_m)
    else:
        sizes = _batches(counts)
        parts = zip(*(values.split(sizes) for values in (face, across, along)), strict=True)
        signed = torch.cat([checkpoint(_signed, flat, *part, softness_m, use_reentrant=False) for part in parts])
    return Coverage(face, pixel, signed, len(corners), pixels)


def picked(values: Float[Tensor, " n"], index: Int64[Tensor, " p"]) -> Float[Tensor, " p"]:
    """values[index]; its gradient is added in a fixed order on the CPU."""
    return values.index_select(0, index)


def summed(values: Float[Tensor, " p"], index: Int64[Tensor, " p"], count: int) -> Float[Tensor, " {count}"]:
    """Sums of the values of equal index."""
    return values.new_zeros(count).index_add(0, index, values)


def grouped_softmax(logits: Float[Tensor, " p"], index: Int64[Tensor, " p"], count: int) -> Float[Tensor, " p"]:
    """Softmax over the logits of equal index."""
    largest = logits.new_zeros(count).scatter_reduce(0, index, logits.detach(), "amax", include_self=False)
    powers = torch.exp(logits - picked(largest, index))
    return powers / picked(summed(powers, index, count).clamp(min=1e-30), index)


def _pairs(
    corners: Float[Tensor, "f 3 2"], lattice: Lattice, softness_m: float
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"], Int64[Tensor, " p"], Int64[Tensor, " f"]]:
    """Face, column and row of each pair, and the number of pairs of each face."""
    if not bool(torch.isfinite(corners).all()):
        raise SarsplatError("a vertex of the mesh is not finite; start again with a lower learning rate")
    size = (lattice.columns, lattice.rows)
    begin, end = [], []
    for axis in range(2):
        step = lattice.step_m[axis]
        # at least one pixel each way, so that small triangles have pixels, too
        reach = max(softness_m * math.sqrt(-math.log(_LEAST_COVERAGE)), step)
        place = (corners[..., axis].double() - lattice.first_m[axis]) / step
        first = torch.ceil(place.amin(1) - reach / step).clamp(-size[axis], 2 * size[axis])
        last = torch.floor(place.amax(1) + reach / step).clamp(-size[axis], 2 * size[axis])
        begin.append(first.long())
        end.append(last.long())
    touching = (end[0] >= 0) & (begin[0] < size[0]) & (end[1] >= 0) & (begin[1] < size[1])
    width = end[0] - begin[0] + 1
    counts = torch.where(touching, width * (end[1] - begin[1] + 1), 0)
    total = int(counts.sum())
    if total > _MOST_PAIRS:
        raise SarsplatError(
            f"the mesh's triangles cover {total:.2g} pixels in all, more than {_MOST_PAIRS:.2g}; give smaller images, "
            "or start again with a lower learning rate"
        )
    face = torch.repeat_interleave(counts)
    position = torch.arange(total, device=corners.device) - (counts.cumsum(0) - counts)[face]
    column = begin[0][face] + position % width[face]
    row = begin[1][face] + position // width[face]
    return face, column, row, counts


def _batches(counts: Int64[Tensor, " f"]) -> list[int]:
    """Sizes of batches of pairs; faces are not split unless they exceed a batch."""
    sizes = [0]
    for count in counts.tolist():
        while count > _PAIRS_AT_ONCE:
            sizes.append(_PAIRS_AT_ONCE)
            count -= _PAIRS_AT_ONCE
        if sizes[-1] + count > _PAIRS_AT_ONCE:
            sizes.append(0)
        sizes[-1] += count
    return sizes


def _signed(
    flat: Float[Tensor, "6 f"],
    face: Int64[Tensor, " p"],
    across: Float[Tensor, " p"],
    along: Float[Tensor, " p"],
    softness_m: float,
) -> Float[Tensor, " p"]:
    """±d²/σ of pairs of a triangle, whose corners are x, y, x, y, x, y in `flat`, and a pixel's centre, m."""
    x = [picked(flat[2 * k], face) - across for k in range(3)]
    y = [picked(flat[2 * k + 1], face) - along for k in range(3)]
    squared, sides = [], []
    for k in range(3):
        n = (k + 1) % 3
        ex, ey = x[n] - x[k], y[n] - y[k]  # an edge, whose nearest point to the pixel is at this share
        share = (-(x[k] * ex + y[k] * ey) / (ex * ex + ey * ey).clamp(min=1e-12)).clamp(0, 1)
        squared.append((x[k] + share * ex) ** 2 + (y[k] + share * ey) ** 2)
        sides.append((x[k] * y[n] - x[n] * y[k]).detach() > 0)
    inside = (sides[0] == sides[1]) & (sides[1] == sides[2])
    nearest = torch.minimum(torch.minimum(squared[0], squared[1]), squared[2]) / softness_m**2
    return torch.where(inside, nearest, -nearest)
