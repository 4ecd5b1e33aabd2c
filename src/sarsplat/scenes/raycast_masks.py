"""True masks of a mesh on flat ground by ray casting: where it appears in an image, and where its shadow falls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes.raycast import Facets, first_hits

if TYPE_CHECKING:
    import trimesh

_PARTS = 4
"""Parts of a pixel along each side that are lit or not."""

_RAYS = 6
"""Along the side of a part: a few hit it also where the surface stands steep to them."""

TARGET, SHADOW = 1, 2


def raycast_mask(mesh: trimesh.Trimesh, view: View, grid: ImageGrid) -> UInt8[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Mask of a mesh that stands on flat ground at z = 0.

    A pixel is target if a surface that the radar sees appears in at least half of it, layover included and however dark
    it is; else it is shadow if the mesh hides at least half of its ground. What lies below the ground is not seen.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Opaque triangles, m; orientation does not matter.
    view, grid
        From where, and where the pixels lie.

    Returns
    -------
    numpy.ndarray, uint8 [rows, columns]
        0 clutter, 1 target (lit), 2 shadow; row 0 near range.

    Raises
    ------
    SarsplatError
        If the mesh needs too many rays, or embreex is missing.
    """
    theta = math.radians(view.grazing_deg)
    parts = np.array(grid.spacing_m) / _PARTS
    # a ray's next neighbour lands farther away in range where a surface slopes as the ground or as a wall does
    spacing = float(parts.min()) / _RAYS
    columns, rows = (
        centers[0] + (np.arange(len(centers) * _PARTS + 1) / _PARTS - 0.5) * width
        for centers, width in ((grid.azimuth_m, grid.spacing_m[0]), (grid.range_m, grid.spacing_m[1]))
    )
    lit = np.zeros((grid.rows * _PARTS, grid.columns * _PARTS), dtype=bool)
    hidden = np.zeros((grid.rows, grid.columns))
    facets = Facets.of(mesh, view)
    for position, face in first_hits(facets, (columns[0], columns[-1]), spacing, (0.5, 0.5)):
        x, y = position.T
        z, z_ground = facets.depth(face, position), y / math.tan(theta)
        above = z < z_ground + 1e-6
        lit |= np.histogram2d(z[above], x[above], (rows, columns))[0] > 0
        hidden += np.histogram2d(z_ground[above], x[above], (rows[::_PARTS], columns[::_PARTS]))[0]
    shares = lit.reshape(grid.rows, _PARTS, grid.columns, _PARTS).mean(axis=(1, 3))
    open_ground = math.prod(grid.spacing_m) * math.tan(theta) / spacing**2
    mask = np.where(hidden >= 0.5 * open_ground, SHADOW, 0)
    return np.where(shares >= 0.5, TARGET, mask).astype(np.uint8)
