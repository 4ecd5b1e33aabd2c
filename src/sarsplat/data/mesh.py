"""Triangle meshes as PLY, GLB, OBJ or STL, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import write_bytes
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import trimesh

_OPTIONS: dict[str, dict[str, Any]] = {
    ".ply": {"vertex_normal": True},
    ".glb": {"include_normals": True},
    ".obj": {"include_normals": True, "include_texture": False, "header": "sarsplat mesh, m"},
    ".stl": {},
}
"""Options of trimesh's exporters, by the suffix of mesh files."""

_GLTF_FROM_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation about x from z up (world) to y up (glTF)."""


@checks_arguments
def write_mesh(path: str | Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh to a .ply, .glb, .obj or .stl file, whole or not at all; an existing file is replaced.

    Files hold normals and colours of its vertices, a PLY also other scalars, such as `gamma0`, but an STL triangles
    alone. Coordinates are in the world frame, z up, metres; the root node of a GLB file rotates them to y up. Raise
    SarsplatError if the name ends otherwise, the mesh has no faces, or the file cannot be written.
    """
    import trimesh

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _OPTIONS:
        raise SarsplatError(f"{path} is not named as a mesh; choose a name that ends in {', '.join(_OPTIONS)}")
    if len(mesh.faces) == 0:
        raise SarsplatError(f"the mesh for {path} has no faces; reconstruct a surface with more points first")
    upright: Any = mesh
    if suffix == ".glb":
        upright = trimesh.Scene()
        upright.add_geometry(mesh, transform=_GLTF_FROM_WORLD)
    data = upright.export(file_type=suffix[1:], **_OPTIONS[suffix])
    write_bytes(path, data.encode() if isinstance(data, str) else data)
