"""A run's mesh in any format of meshes."""

from __future__ import annotations

from pathlib import Path

from sarsplat.data import write_mesh
from sarsplat.errors import counted
from sarsplat.exports.contents import mesh_of
from sarsplat.names import Colour
from sarsplat.reconstruction import Run


def write_mesh_of(run: Run, path: Path, _: Colour) -> str:
    """See `Write`; the ending of the path says in which format."""
    mesh = mesh_of(run)
    write_mesh(path, mesh)
    return f"{counted(len(mesh.faces), 'triangle')}, metres, z up"
