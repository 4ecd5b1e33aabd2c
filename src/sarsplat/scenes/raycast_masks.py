"""True masks of a mesh on flat ground, by ray casting: where it appears in an image, and where its shadow falls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, View
from sarsplat.scenes._rays import Facets, first_hits
from sarsplat.scenes.raycast import check_rays

if TYPE_CHECKING:
    import trimesh

_PARTS = 5  # along each side of a pixel, each lit or not
_RAYS = 2  # along the shorter side of a part, so that every part of a surface has one
_OFFSET = 0.5, 0.5


def raycast_masks(
    mesh: trimesh.Trimesh, views: Sequence[View], grid: ImageGrid, *, progress: Callable[[int], object] | None = None
) -> UInt8[np.ndarray, "v {grid.rows} {grid.columns}"]:
    """Masks of a mesh from every view, see `raycast_mask`; `progress` gets the number of finished ones after each."""
    masks = np.empty((len(views), grid.rows, grid.columns), np.uint8)
    for index, view in enumerate(views):
        masks[index] = raycast_mask(mesh, view, grid)
        if progress is not None:
            progress(index + 1)
    return masks


def raycast_mask(mesh: trimesh.Trimesh, view: View, grid: ImageGrid) -> UInt8[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Mask of a mesh that stands on flat ground at z = 0: 0 clutter, 1 target (lit), 2 shadow; row 0 near range.

    A pixel is target if visible surfaces cover at least half of it, or if their area across the line of sight is at
    least half that of flat ground: what faces the radar covers little of the image. Layover counts; neither brightness
    nor resolution nor the orientation of the triangles matters. Otherwise it is shadow if the mesh hides at least half
    of its ground. Nothing below the ground is seen. Raises `SarsplatError` if the mesh has no faces, is not finite or
    needs too many rays, or embreex is missing.
    """
    spacing = min(grid.spacing_m) / _PARTS / _RAYS
    check_rays(mesh, None, spacing, _OFFSET)
    slope_of_ground = 1 / view.look.slope
    width, depth = grid.spacing_m
    left, near = grid.azimuth_m[0] - width / 2, grid.range_m[0] - depth / 2
    rows, columns = grid.rows * _PARTS, grid.columns * _PARTS
    begun = np.zeros((rows + 1) * columns, dtype=np.int64)  # surfaces that begin in a part, less those that have ended
    appearing, hidden = np.zeros((2, grid.rows, grid.columns), dtype=np.int64)  # rays
    facets = Facets.of(mesh, view)
    for position, face in first_hits(facets, (left, left + grid.columns * width), spacing, _OFFSET):
        x, y = position.T
        z, z_ground = facets.depth(face, position), y * slope_of_ground
        column = np.floor((x - left) / width * _PARTS)
        seen = (z < z_ground + 1e-6) & (column >= 0) & (column < columns)
        z, z_ground, face, column = z[seen], z_ground[seen], face[seen], column[seen].astype(np.int64)
        # one ray represents a square, which on a steep surface spans several parts in range
        reach = np.abs(facets.slope[face]).sum(axis=1) * spacing / 2
        ends = (np.clip(end, *facets.z_span[:, face]) for end in (z - reach, z + reach))
        # it covers the parts with centres between both ends
        first, beyond = (np.ceil((end - near) / depth * _PARTS - 0.5) for end in ends)
        for row, sign in ((first, 1), (beyond, -1)):
            parts = np.clip(row, 0, rows).astype(np.int64) * columns + column
            begun += sign * np.bincount(parts, minlength=len(begun))
        for counts, ranges in ((appearing, z), (hidden, z_ground)):
            row = np.floor((ranges - near) / depth)
            inside = (row >= 0) & (row < grid.rows)
            pixels = row[inside].astype(np.int64) * grid.columns + column[inside] // _PARTS
            counts += np.bincount(pixels, minlength=counts.size).reshape(counts.shape)
    covered = begun.reshape(rows + 1, columns)[:-1].cumsum(axis=0) > 0
    shares = covered.reshape(grid.rows, _PARTS, grid.columns, _PARTS).mean(axis=(1, 3))
    rays_on_open_ground = width * depth / slope_of_ground / spacing**2
    mask = np.where(hidden >= 0.5 * rays_on_open_ground, SHADOW, CLUTTER)
    lit = (shares >= 0.5) | (appearing >= 0.5 * rays_on_open_ground)
    return np.where(lit, TARGET, mask).astype(np.uint8)
