"""Triangle meshes as PLY, GLB or OBJ, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.data.files import write_bytes
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".ply", ".glb", ".obj")
"""How names of mesh files end."""


def write_mesh(path: str | Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh with its normals and colours at the vertices, whole or not at all.

    A PLY file also holds the vertices' other scalars, such as `gamma0`. The axes are the world's in every format: z up,
    metres.

    Parameters
    ----------
    path : str or Path
        A .ply, .glb or .obj file; an existing one is replaced.
    mesh : trimesh.Trimesh
        At least one face.

    Raises
    ------
    SarsplatError
        If the name ends otherwise, the mesh has no faces, or the file cannot be written.
    """
    from trimesh.exchange.gltf import export_glb
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.ply import export_ply

    path = Path(path)
    if len(mesh.faces) == 0:
        raise SarsplatError(f"the mesh for {path} has no faces; reconstruct a surface with more points first")
    match path.suffix.lower():
        case ".ply":
            data = export_ply(mesh, vertex_normal=True)
        case ".glb":
            data = export_glb(mesh.scene(), include_normals=True)
        case ".obj":
            data = export_obj(mesh, include_normals=True, include_texture=False, header="sarsplat mesh, m").encode()
        case _:
            raise SarsplatError(f"{path} is not named as a mesh; choose a name that ends in {', '.join(MESH_FORMATS)}")
    write_bytes(path, data)
