"""Adaptive ray sampling: dense near outlines, sparse within flat patches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from sarsplat.scenes._patches import Patches, entered_cells
from sarsplat.scenes._rays import Facets, Region, Trace, turned

_RAYS_PER_SIDE = 8  # of a square
_SQUARES_PER_TILE = 128  # along a side
_SQUARES_PER_BATCH = 1 << 12

# Cross-section of a flat patch is deposited in steps of at most this part of the resolution. Responses show no moiré of
# them up to .6, nor the sharing of each deposit between nodes up to .2: shadows stay dark to a thousandth.
_FLAT_STEP = 0.2


@dataclass(frozen=True)
class Hits:
    """First hits of rays, each for an area across the line of sight."""

    position: Float64[np.ndarray, "k 2"]  # (x_r, y_r), m
    slant_range: Float64[np.ndarray, " k"]  # z_r, m
    face: Int32[np.ndarray, " k"]
    area: float | Float64[np.ndarray, " k"]  # m²


def sparse_hits(
    facets: Facets,
    patches: Patches,
    trace: Trace,
    region: Region,
    spacing: float,
    offset: tuple[float, float],
    resolution: tuple[float, float],
    least_slope: float,
    progress: Callable[[float], object],
) -> Iterator[Hits]:
    """First hits in a region: `spacing` apart near outlines of patches, sparser within them.

    The region is divided into squares of 8 × 8 rays. A square that no outline enters and whose corners see the same
    patch needs no further ray: it is deposited in as many steps as the slope of the patch, or `least_slope` along y_r,
    needs to look continuous at the resolution (azimuth, range). The others get all of their rays. `progress` is called
    with the share that is done.
    """
    side = _RAYS_PER_SIDE * spacing
    origin = np.array(offset) - 0.5

    def position(square: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
        return turned(spacing * (_RAYS_PER_SIDE * square + origin))

    def square(position: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
        return (turned(position, back=True) / spacing - origin) / _RAYS_PER_SIDE

    region.check(spacing, _RAYS_PER_SIDE)
    (left, right), (low, high) = region.x, region.y
    around = square(np.array([(x, y) for x in region.x for y in region.y]))
    first = np.floor(around.min(axis=0)).astype(np.int64)
    columns, rows = (int(count) for count in np.ceil(around.max(axis=0)).astype(np.int64) - first)
    places, edges = square(facets.vertices[:, :2]) - first, patches.outlines_from(facets.vertices[:, :2])
    outlined = entered_cells(places[edges[:, 0]], places[edges[:, 1]], (max(rows, 1), max(columns, 1)))
    parts = _parts(facets, patches, side, resolution, least_slope)
    tiles = [
        (row, column) for row in range(0, rows, _SQUARES_PER_TILE) for column in range(0, columns, _SQUARES_PER_TILE)
    ]
    for done, (row, column) in enumerate(tiles):
        progress(done / len(tiles))
        tile = outlined[row : row + _SQUARES_PER_TILE, column : column + _SQUARES_PER_TILE]
        v, u = np.mgrid[: tile.shape[0] + 1, : tile.shape[1] + 1] + np.array([row, column])[:, None, None]
        corners = position(np.stack([u, v], axis=-1).reshape(-1, 2) + first)
        if (corners.max(axis=0) < (left, low)).any() or (corners.min(axis=0) > (right, high)).any():
            continue
        face = trace(corners)
        seen = np.where(face >= 0, patches.of_face[face], -1).reshape(u.shape)
        patch = seen[:-1, :-1]
        whole = (patch == seen[1:, :-1]) & (patch == seen[:-1, 1:]) & (patch == seen[1:, 1:]) & ~tile
        squares = np.stack([u[:-1, :-1], v[:-1, :-1]], axis=-1) + first
        flat = whole & (patch >= 0)
        if flat.any():
            yield _flat(facets, patches, patch[flat], squares[flat], parts, position, side)
        broken = squares[~whole]
        for begin in range(0, len(broken), _SQUARES_PER_BATCH):
            at = position(_centers(broken[begin : begin + _SQUARES_PER_BATCH], np.full(2, _RAYS_PER_SIDE))[0])
            face = trace(at)
            hit = face >= 0
            at, face = at[hit], face[hit]
            yield Hits(at, facets.depth(face, at), face, spacing**2)
    progress(1.0)


def _parts(
    facets: Facets, patches: Patches, side: float, resolution: tuple[float, float], least_slope: float
) -> Int64[np.ndarray, "patches 2"]:
    """Number of parts along each side into which a square within a patch is divided."""
    axes = turned(np.eye(2))  # unit vectors along the sides
    slope = facets.slope[patches.largest_face]
    along_range = np.maximum(np.abs(slope @ axes.T), least_slope * np.abs(axes[:, 1])) / resolution[1]
    steps = side * np.maximum(along_range, np.abs(axes[:, 0]) / resolution[0])
    return np.clip(np.ceil(steps / _FLAT_STEP), 1, _RAYS_PER_SIDE).astype(np.int64)


def _flat(
    facets: Facets,
    patches: Patches,
    patch: Int64[np.ndarray, " k"],
    squares: Int64[np.ndarray, "k 2"],
    parts: Int64[np.ndarray, "patches 2"],
    position: Callable[[Float64[np.ndarray, "n 2"]], Float64[np.ndarray, "n 2"]],
    side: float,
) -> Hits:
    """Squares within patches as hits."""
    centers, square = _centers(squares, parts[patch])
    at = position(centers)
    face = patches.largest_face[patch][square]
    slant_range = facets.z0[face] + (facets.slope[face] * at).sum(axis=1)
    return Hits(at, slant_range, face.astype(np.int32), (side**2 / parts.prod(axis=1))[patch][square])


def _centers(
    squares: Int64[np.ndarray, "k 2"], parts: Int64[np.ndarray, "*k 2"]
) -> tuple[Float64[np.ndarray, "n 2"], Int64[np.ndarray, " n"]]:
    """Centres of the parts of squares, in sides, and the square of each."""
    parts = np.broadcast_to(parts, squares.shape)
    count = parts.prod(axis=1)
    square = np.repeat(np.arange(len(squares)), count)
    number = np.arange(len(square)) - np.repeat(np.cumsum(count) - count, count)
    along, across = parts[square].T
    row, column = np.divmod(number, along)
    within = np.column_stack([(column + 0.5) / along, (row + 0.5) / across])
    return squares[square] + within, square
