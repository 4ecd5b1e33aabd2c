"""Meshes from files, dirty ones included."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import trimesh

_LARGEST_TARGET = 200.0  # m; beyond it, a vehicle given in millimetres is likelier
_SMALLEST_TARGET = 0.5  # m; below it, one given in kilometres


def load_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Triangle mesh of a file in any format trimesh reads; a scene's parts become one mesh.

    Open, intersecting and inconsistently oriented surfaces are taken as they are. Faces that are degenerate, doubled or
    have a vertex that is not finite are dropped with one warning.

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
        If the file is missing, is not a mesh, or has no usable face.

    Warns
    -----
    UserWarning
        If faces were dropped, or the extent suggests that the file is not in metres.
    """
    path = Path(path)
    if not path.is_file():
        raise SarsplatError(f"there is no mesh file at '{path}'; give the path of an .obj, .stl, .ply, .glb … file")
    mesh = _read(path)
    if len(mesh.faces) == 0:
        raise SarsplatError(f"'{path}' holds no faces, only {len(mesh.vertices)} vertices; give a triangle mesh")
    before = len(mesh.faces)
    usable = _usable_faces(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces))
    if not usable.any():
        raise SarsplatError(f"none of the {before} faces of '{path}' is finite with a positive area; repair the mesh")
    mesh.update_faces(usable)
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < before:
        warnings.warn(
            f"'{path}': dropped {before - len(mesh.faces)} of {before} faces (degenerate, doubled or not finite)",
            stacklevel=2,
        )
    extent = float(mesh.extents.max())
    if not _SMALLEST_TARGET <= extent <= _LARGEST_TARGET:
        warnings.warn(
            f"'{path}' is {extent:.3g} m long if its unit is the metre; scale it if it is in another unit", stacklevel=2
        )
    return mesh


def _read(path: Path) -> trimesh.Trimesh:
    import trimesh

    try:
        # Unprocessed: merging vertices would move them, and materials are of no use here.
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
        return scene.to_mesh()
    except Exception as error:  # the readers behind trimesh raise whatever their parsers raise
        raise SarsplatError(
            f"'{path}' cannot be read as a mesh ({error}); give an .obj, .stl, .ply, .glb … file"
        ) from error


def _usable_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces [F] are finite, have an area, and are not the same triangle as an earlier one."""
    corners = vertices[faces]
    with np.errstate(invalid="ignore", over="ignore"):
        area2 = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    usable = np.isfinite(corners).all(axis=(1, 2)) & np.isfinite(area2) & (area2 > 0)
    # Triangles are the same if their corners coincide, whatever their order and vertex numbers.
    _, number = np.unique(vertices, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(number.reshape(-1)[faces], axis=1), axis=0, return_index=True)
    usable[np.setdiff1d(np.arange(len(faces)), first)] = False
    return usable
