"""The part of a triangle mesh that the radar sees, as points: what our own method gives, too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from sarsplat.geometry import View, radar_frame
from sarsplat.scenes.raycast import Facets, first_hits

if TYPE_CHECKING:
    import trimesh

Points = Float32[np.ndarray, "p 3"]


def seen_points(mesh: trimesh.Trimesh, views: Sequence[View], spacing_m: float) -> tuple[Points, Points]:
    """Points where parallel rays of any view first meet a mesh, and the normals there.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        World frame, m.
    views : sequence of View
        From where.
    spacing_m : float
        Distance of neighbouring rays; of the points in each cube of this side one is kept.

    Returns
    -------
    points, normals : numpy.ndarray, float32 [P, 3]
        Metres, world frame; normals are of unit length, on the side that the radar saw.

    Raises
    ------
    SarsplatError
        If the mesh needs too many rays, or embreex is missing.
    """
    points, normals = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
    for view in views if len(mesh.faces) else ():
        frame, facets = radar_frame(view), Facets.of(mesh, view)
        for position, face in first_hits(facets, (-np.inf, np.inf), spacing_m, (0.5, 0.5)):
            hit = np.column_stack([position, facets.depth(face, position)]) @ frame
            normal = mesh.face_normals[face]
            normal = normal * np.sign(normal @ view.direction)[:, None]
            points = np.concatenate([points, hit.astype(np.float32)])
            normals = np.concatenate([normals, normal.astype(np.float32)])
        kept = np.unique(np.floor(points / spacing_m).astype(np.int64), axis=0, return_index=True)[1]
        kept.sort()
        points, normals = points[kept], normals[kept]
    return points, normals
