"""Triangle meshes as PLY, GLB, OBJ or STL, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import write_bytes
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".ply", ".glb", ".obj", ".stl")
"""Suffixes of mesh files."""

_GLTF_FROM_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation about x from z up (world) to y up (glTF)."""


@checks_arguments
def write_mesh(path: str | Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh with normals and colours of its vertices, whole or not at all.

    A PLY file also holds other scalars of the vertices, such as `gamma0`; an STL file holds triangles alone.
    Coordinates are in the world frame, z up, metres; the root node of a GLB file rotates them to y up.

    Parameters
    ----------
    path : str or Path
        A .ply, .glb, .obj or .stl file; an existing one is replaced.
    mesh : trimesh.Trimesh
        At least one face.

    Raises
    ------
    SarsplatError
        If the name ends otherwise, the mesh has no faces, or the file cannot be written.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.ply import export_ply
    from trimesh.exchange.stl import export_stl

    path = Path(path)
    if len(mesh.faces) == 0:
        raise SarsplatError(f"the mesh for {path} has no faces; reconstruct a surface with more points first")
    match path.suffix.lower():
        case ".ply":
            data = export_ply(mesh, vertex_normal=True)
        case ".glb":
            upright = trimesh.Scene()
            upright.add_geometry(mesh, transform=_GLTF_FROM_WORLD)
            data = export_glb(upright, include_normals=True)
        case ".obj":
            data = export_obj(mesh, include_normals=True, include_texture=False, header="sarsplat mesh, m").encode()
        case ".stl":
            data = export_stl(mesh)
        case _:
            raise SarsplatError(f"{path} is not named as a mesh; choose a name that ends in {', '.join(MESH_FORMATS)}")
    write_bytes(path, data)
