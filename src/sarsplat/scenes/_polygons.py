"""Triangles of polygons, concave ones too: ears are cut off one by one.

A fan from the first corner, which most readers make, covers a concave polygon wrongly, and a warped one differently by
where its outline begins. What is a fan whatever its first corner, flat and convex, stays one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

from sarsplat.errors import SarsplatError

_FLAT = 1e-6  # of its size: how far a corner may be from the plane of a flat polygon
_ROUNDINGS = 1e-9  # of its size squared: areas that are none
_TIE = 1e-7  # of its size: diagonals of equal length differ by that, along a direction that no outline prefers
_ASIDE = np.array([0.36, 0.48, 0.8])
_MOST_CORNERS = 2_000  # of a polygon that is no fan: the time grows with their square
_MOST_WORK = 200_000_000  # squares of corners in all: half a minute
_AT_ONCE = 1_000_000  # places before edges


@dataclass(frozen=True)
class Triangulation:
    """Triangles of M polygons with N corners each.

    Attributes
    ----------
    triangles : numpy.ndarray, int64 [M, N − 2, 3]
        Corners of the triangles, as numbers from 0 to N − 1.
    crossed : int
        Polygons whose outline crosses itself, so that no triangles cover what it encloses.
    """

    triangles: Int[np.ndarray, "m t 3"]
    crossed: int


def are_fans(corners: Float64[np.ndarray, "m n 3"]) -> Bool[np.ndarray, " m"]:
    """Which polygons are flat and convex, so that triangles from any of their corners to all others cover them."""
    flat, plane, size = _in_its_plane(corners)
    ahead, back = np.roll(flat, -1, axis=1), np.roll(flat, 1, axis=1)
    least = -_ROUNDINGS * size[:, None] ** 2
    turns = _area(back, flat, ahead) >= least
    fan = _area(flat[:, :1], flat[:, 1:-1], flat[:, 2:]) >= least
    level = np.abs(plane) <= _FLAT * size[:, None]
    same: Bool[np.ndarray, " m"] = turns.all(1) & fan.all(1) & level.all(1)
    return same


def triangulated(corners: Float64[np.ndarray, "m n 3"]) -> Triangulation:
    """Triangles of polygons with equally many corners, the same ones wherever an outline begins.

    Ears with the shortest diagonal come first. Raises `SarsplatError` if there are far too many corners.
    """
    count, number, _ = corners.shape
    if number > _MOST_CORNERS or count * number**2 > _MOST_WORK:
        raise SarsplatError(f"{count:,} of its faces are concave with {number:,} corners; triangulate it beforehand")
    triangles = np.empty((count, number - 2, 3), np.int64)
    crossed, step = 0, max(_AT_ONCE // number**2, 1)
    for first in range(0, count, step):
        part = slice(first, first + step)
        triangles[part], some = _cut(corners[part])
        crossed += some
    return Triangulation(triangles, crossed)


def _cut(corners: Float64[np.ndarray, "m n 3"]) -> tuple[Int[np.ndarray, "m t 3"], int]:
    """Triangles, and how many of the outlines cross themselves."""
    count, number, _ = corners.shape
    rows = np.arange(count)
    flat, _, size = _in_its_plane(corners)
    centred = (corners - corners.mean(axis=1, keepdims=True)) / np.where(size > 0, size, 1)[:, None, None]
    outline = _Outline(flat, centred, _ROUNDINGS * size**2)
    left = np.tile(np.arange(number), (count, 1))
    cost = outline.cost(left, left.copy(), strictly=True)
    triangles, crossed = [], np.zeros(count, bool)
    for many in range(number, 3, -1):
        ear = cost.argmin(axis=1)
        stuck = np.flatnonzero(np.isinf(cost[rows, ear]))
        if len(stuck):  # corners that touch edges, then outlines that cross themselves
            loosely = outline.of(stuck).cost(left[stuck], left[stuck], strictly=False)
            ear[stuck] = loosely.argmin(axis=1)
            none = np.isinf(loosely.min(axis=1))
            area = np.abs(outline.of(stuck).area(left[stuck]))
            ear[stuck[none]] = area[none].argmin(axis=1)
            crossed[stuck[none]] |= area[none].min(axis=1) > outline.least[stuck[none]]
        before, after = (ear - 1) % many, (ear + 1) % many
        triangles.append(np.stack([left[rows, before], left[rows, ear], left[rows, after]], axis=1))
        kept = np.ones_like(left, dtype=bool)
        kept[rows, ear] = False
        left, cost = (table[kept].reshape(count, many - 1) for table in (left, cost))
        for place in ((ear - 1) % (many - 1), ear % (many - 1)):  # the others' neighbours are the same as before
            cost[rows, place] = outline.cost(left, left[rows, place][:, None], strictly=True, places=place)[:, 0]
    triangles.append(left)
    crossed |= outline.area(left)[:, 0] < -outline.least  # what remains is turned over
    return np.stack(triangles, axis=1), int(crossed.sum())


@dataclass(frozen=True)
class _Outline:
    """Corners in the plane of each polygon, and around its middle in units of its size; areas that are none."""

    flat: Float64[np.ndarray, "m n 2"]
    centred: Float64[np.ndarray, "m n 3"]
    least: Float64[np.ndarray, " m"]

    def of(self, rows: Int[np.ndarray, " k"]) -> _Outline:
        return _Outline(self.flat[rows], self.centred[rows], self.least[rows])

    def area(self, left: Int[np.ndarray, "m k"]) -> Float64[np.ndarray, "m k"]:
        """Twice the area of the triangle at each of the corners that are left; negative where it lies outside."""
        here, before, after = (np.roll(left, by, axis=1) for by in (0, 1, -1))
        return _area(*(np.take_along_axis(self.flat, which[:, :, None], 1) for which in (before, here, after)))

    def cost(
        self,
        left: Int[np.ndarray, "m k"],
        asked: Int[np.ndarray, "m j"],
        *,
        strictly: bool,
        places: Int[np.ndarray, " m"] | None = None,
    ) -> Float64[np.ndarray, "m j"]:
        """Length of the diagonal that cuts off each corner `asked` for; infinite where it is no ear.

        `places` is where the corners asked for are among those that are left, of one for each polygon; otherwise all
        are asked for. `strictly`: nor is it one if another corner lies on its edge.
        """
        where = np.arange(left.shape[1])[None] if places is None else places[:, None]
        before, after = (
            np.take_along_axis(left, np.broadcast_to((where + by) % left.shape[1], asked.shape), 1) for by in (-1, 1)
        )
        a, b, c = (np.take_along_axis(self.flat, which[:, :, None], 1) for which in (before, asked, after))
        others = np.take_along_axis(self.flat, left[:, :, None], 1)[:, None]  # [M, 1, K, 2]
        least = self.least[:, None, None]
        A, B, C = a[:, :, None], b[:, :, None], c[:, :, None]
        sides = np.stack([_area(A, B, others), _area(B, C, others), _area(C, A, others)])
        inside = (sides >= -least).all(axis=0) if strictly else (sides > least).all(axis=0)
        for corner in (A, B, C):
            inside &= ~(others == corner).all(axis=-1)
        following = np.roll(others, -1, axis=2)
        from_a, from_c = _area(others, following, A), _area(others, following, C)
        one, other = sides[2], np.roll(sides[2], -1, axis=2)
        crosses = (np.abs(one) > least) & (np.abs(other) > least) & ((one > 0) != (other > 0))
        crosses &= (np.abs(from_a) > least) & (np.abs(from_c) > least) & ((from_a > 0) != (from_c > 0))
        ear = (_area(a, b, c) > self.least[:, None]) & ~inside.any(axis=-1) & ~crosses.any(axis=-1)
        start, end = (np.take_along_axis(self.centred, which[:, :, None], 1) for which in (before, after))
        length = np.linalg.norm(end - start, axis=2) + _TIE * ((start + end) @ _ASIDE)
        return np.where(ear, length, np.inf)


def _in_its_plane(
    corners: Float64[np.ndarray, "m n 3"],
) -> tuple[Float64[np.ndarray, "m n 2"], Float64[np.ndarray, "m n"], Float64[np.ndarray, " m"]]:
    """Each polygon as seen along its normal, counter-clockwise; distances from its mean plane; and its size."""
    centred = corners - corners.mean(axis=1, keepdims=True)
    size = np.abs(centred).max(axis=(1, 2))
    normal = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(least, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    seen = np.stack([np.einsum("mnk,mk->mn", centred, axis) for axis in (first, second)], axis=2)
    return seen, np.einsum("mnk,mk->mn", centred, normal), size


def _area(
    a: Float64[np.ndarray, "*#t 2"], b: Float64[np.ndarray, "*#t 2"], c: Float64[np.ndarray, "*#t 2"]
) -> Float64[np.ndarray, "*#t"]:
    """Twice the area of triangles, negative where they are clockwise."""
    area: Float64[np.ndarray, "*#t"]
    area = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    return area
