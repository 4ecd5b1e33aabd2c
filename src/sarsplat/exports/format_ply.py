"""`.ply`: Gaussians for viewers of 3D Gaussian splatting, points, or a mesh."""

from __future__ import annotations

from pathlib import Path

from sarsplat.data import write_gaussians_ply, write_points_ply
from sarsplat.errors import counted
from sarsplat.exports.contents import gaussians_of, points_of
from sarsplat.exports.format import Format
from sarsplat.exports.meshes import write_mesh_of
from sarsplat.names import Colour
from sarsplat.reconstruction import Run


def _gaussians(run: Run, path: Path, colour: Colour) -> str:
    gaussians = gaussians_of(run)
    write_gaussians_ply(path, gaussians, colour=colour)
    return counted(len(gaussians), "Gaussian")


def _points(run: Run, path: Path, _: Colour) -> str:
    points = points_of(run)
    write_points_ply(path, points.positions, **points.columns())
    return f"{counted(len(points.positions), 'point')}, metres"


FORMAT = Format(
    writers={"gaussians": _gaussians, "points": _points, "mesh": write_mesh_of},
    opened_with={
        "gaussians": "any 3D Gaussian splatting viewer",
        "points": "any point cloud viewer",
        "mesh": "any mesh viewer",
    },
    recognises=lambda head, _: head.startswith(b"ply\n"),
)
