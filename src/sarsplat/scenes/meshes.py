"""Targets from mesh files, dirty ones included."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.scenes.mesh_files import read_mesh

if TYPE_CHECKING:
    import trimesh

_LARGEST_TARGET = 200.0  # m; beyond it, a vehicle given in millimetres is likelier
_SMALLEST_TARGET = 0.5  # m; below it, one given in kilometres


def load_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Triangle mesh of an .obj, .stl, .ply, .off or .glb file; a scene's parts become one mesh.

    Open, intersecting and inconsistently oriented surfaces are taken as they are. Faces that are degenerate or have a
    vertex that is not finite are dropped with one warning; of equal faces, such as where two closed bodies touch, one
    is kept, which leaves the surface as it was.

    Parameters
    ----------
    path : path
        File, in metres, +x nose, +y left, +z up, ground at z = 0.

    Returns
    -------
    trimesh.Trimesh
        Every face with a positive area, once.

    Raises
    ------
    SarsplatError
        If the file is missing or damaged, is not a mesh, or has no usable face (see `read_mesh`).

    Warns
    -----
    SarsplatWarning
        If faces were dropped, or the extent suggests that the file is not in metres.
    """
    path = Path(path)
    mesh = read_mesh(path)
    count = len(mesh.faces)
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    usable = _have_area(vertices, faces)
    if not usable.any():
        raise SarsplatError(f"none of the {count} faces of '{path}' is finite with a positive area; repair the mesh")
    if not usable.all():
        warnings.warn(
            f"'{path}': dropped {count - usable.sum()} of {count} faces (degenerate or not finite)",
            SarsplatWarning,
            stacklevel=2,
        )
    mesh.update_faces(usable & _first_of_equals(vertices, faces))
    mesh.remove_unreferenced_vertices()
    extent = float(mesh.extents.max())
    if not _SMALLEST_TARGET <= extent <= _LARGEST_TARGET:
        warnings.warn(
            f"'{path}' is {extent:.3g} m long if its unit is the metre; scale it if it is in another unit",
            SarsplatWarning,
            stacklevel=2,
        )
    return mesh


def _have_area(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Which faces [F] are finite and have an area."""
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(invalid="ignore"):  # of infinities; no finite vertex is so far away that its square is one
        area2 = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    return np.isfinite(area2) & (area2 > 0)


def _first_of_equals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Which faces [F] are not the same triangle as an earlier one, whatever the order and numbers of their vertices."""
    _, number = np.unique(vertices, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(number.reshape(-1)[faces], axis=1), axis=0, return_index=True)
    chosen = np.zeros(len(faces), dtype=bool)
    chosen[first] = True
    return chosen
