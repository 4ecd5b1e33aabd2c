"""`.ply`: Gaussians for viewers of 3D Gaussian splatting, points, or a mesh."""

from sarsplat.data import write_gaussians_ply, write_mesh, write_points_ply
from sarsplat.exports.format import Format

FORMAT = Format(
    writers={
        "gaussians": lambda gaussians, path, colour: write_gaussians_ply(path, gaussians, colour=colour),
        "points": lambda points, path, _: write_points_ply(path, points.positions, **points.columns()),
        "mesh": lambda mesh, path, _: write_mesh(path, mesh),
    },
    opened_with={
        "gaussians": "any 3D Gaussian splatting viewer",
        "points": "any point cloud viewer",
        "mesh": "any mesh viewer",
    },
    recognises=lambda head, _: head.startswith(b"ply\n"),
)
