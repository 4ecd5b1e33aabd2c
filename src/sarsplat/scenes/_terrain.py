"""Terrain as triangles below a target, so that ray casting handles occlusion."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sarsplat.geometry import ImageGrid, Terrain

if TYPE_CHECKING:
    import trimesh

_STEEPEST_DEG = 85.0  # grazing angle of views whose images are to be full of ground


def on_terrain(mesh: trimesh.Trimesh, terrain: Terrain, grid: ImageGrid) -> trimesh.Trimesh:
    """The mesh and, after its faces, two for each square of the terrain, level beyond its end."""
    import trimesh

    sides = (grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0])
    reach = (math.hypot(*sides) + math.hypot(*grid.center_m)) / math.cos(math.radians(_STEEPEST_DEG))
    places = terrain.padded(reach)
    rows, columns = places.shape[:2]
    at = np.arange(rows * columns).reshape(rows, columns) + len(mesh.vertices)
    corner, right, up, both = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.column_stack(three) for three in ((corner, right, both), (corner, both, up))])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices, places.reshape(-1, 3)]), np.concatenate([mesh.faces, faces]), process=False
    )
