"""Targets from mesh files, dirty ones included."""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid
from sarsplat.scenes.mesh_files import read_mesh

if TYPE_CHECKING:
    import trimesh

# Plausible sizes of a target, in image sides and in resolution widths. A vehicle in inches, centimetres, millimetres or
# kilometres is outside.
_LARGEST_TARGET, _SMALLEST_TARGET = 1.0, 2.0


@checks_arguments
def load_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Triangle mesh of an .obj, .stl, .ply, .off or .glb file; a scene's parts become one mesh.

    Open, intersecting and inconsistently oriented surfaces are accepted unchanged. Faces that are degenerate or have a
    vertex that is not finite are dropped with one warning; one of several equal faces, such as where two closed bodies
    touch, is kept, so the surface does not change.

    Parameters
    ----------
    path : path
        File, +x nose, +y left, +z up, ground at z = 0; coordinates in metres.

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
        If faces were dropped.
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
    return mesh


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    """The mesh with every coordinate multiplied by a factor, which must be positive and finite."""
    if not (math.isfinite(factor) and factor > 0):
        raise SarsplatError(f"scale {factor} must be positive and finite; 0.001 makes metres of millimetres")
    return mesh.copy().apply_scale(factor)


def is_larger(mesh: trimesh.Trimesh, grid: ImageGrid) -> bool:
    """Whether a mesh is longer than its images are wide, along their shorter side."""
    return float(mesh.extents.max()) > _LARGEST_TARGET * _side_m(grid)


def suspicious_size(mesh: trimesh.Trimesh, grid: ImageGrid) -> list[str]:
    """A sentence if a mesh is larger than its images or hardly larger than a resolution cell, otherwise nothing."""
    extent = float(mesh.extents.max())
    cell = max(grid.resolution_m)
    if _SMALLEST_TARGET * cell <= extent and not is_larger(mesh, grid):
        return []
    return [
        f"the target is {extent:.3g} m long, but the images are {_side_m(grid):.3g} m wide with a resolution of "
        f"{cell:.3g} m; if the mesh is not in metres, give --scale, otherwise other --pixels or --spacing"
    ]


def _side_m(grid: ImageGrid) -> float:
    return min(grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0])


def _have_area(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Mask of the faces [F] that are finite and have an area."""
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(invalid="ignore"):  # infinite vertices; the squares of finite ones do not overflow
        area2 = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    return np.isfinite(area2) & (area2 > 0)


def _first_of_equals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Mask of the faces [F] that do not repeat an earlier triangle, in any order and numbering of vertices."""
    _, number = np.unique(vertices, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(number.reshape(-1)[faces], axis=1), axis=0, return_index=True)
    return np.isin(np.arange(len(faces)), first)
