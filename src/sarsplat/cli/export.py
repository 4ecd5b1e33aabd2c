"""`sarsplat export`: a run in, one file for other programs out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import RunFolder, refuse_existing
from sarsplat.errors import SarsplatError

_Content = Literal["gaussians", "points", "mesh"]
_ENDINGS: dict[_Content, tuple[str, ...]] = {
    "gaussians": (".ply",),
    "points": (".ply",),
    "mesh": (".ply", ".glb", ".obj"),
}


def export(
    run: RunFolder,
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    *,
    format: Annotated[_Content | None, tyro.conf.arg(help_behavior_hint="(optional)")] = None,
    overwrite: bool = False,
) -> None:
    """Write a run's Gaussians, points or mesh to one file.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
    file
        File to write: .ply, or .glb or .obj for a mesh.
    format
        gaussians: in the layout of 3D Gaussian splatting; points: of the surface, metres, with normals; mesh:
        triangles through the points, with normals and γ⁰ at the vertices. By default Gaussians in a .ply file, a mesh
        in the others.
    overwrite
        Replace an existing file of the same kind.
    """
    from sarsplat.data import write_gaussians_ply, write_mesh, write_points_ply
    from sarsplat.reconstruction import Run
    from sarsplat.rivals import open_run

    content = _content(file, format)
    done = open_run(run)
    refuse_existing(file, overwrite)
    _refuse_others(file, run)
    if content == "gaussians":
        if not isinstance(done, Run):
            raise SarsplatError(f"{run} was made by {done.method}, which learns no Gaussians; export --format points")
        gaussians = done.gaussians
        write_gaussians_ply(file, gaussians)
        console.finish(f"{file}: {len(gaussians)} Gaussians", f"open {file} in any 3D Gaussian splatting viewer")
    elif content == "points":
        if not len(done.points):
            raise SarsplatError(f"{run} has no points of a surface yet; train it longer, or look at its report")
        with console.busy(f"points of {run} with their normals"):
            write_points_ply(file, done.points, normals=done.normals)
        console.finish(f"{file}: {len(done.points)} points, metres", f"open {file} in any point cloud or mesh viewer")
    else:
        with console.busy(f"a surface through the points of {run}"):
            mesh = done.mesh()
            write_mesh(file, mesh)
        console.finish(f"{file}: {len(mesh.faces)} triangles, metres, z up", f"open {file} in any mesh viewer")


def _content(file: Path, asked: _Content | None) -> _Content:
    """What is written to a file of this name."""
    ending = file.suffix.lower()
    content = asked or ("mesh" if ending in (".glb", ".obj") else "gaussians")
    if ending not in _ENDINGS[content]:
        what = "an export" if asked is None else "a mesh" if content == "mesh" else content
        known = _ENDINGS["mesh" if asked is None else content]
        endings = " or ".join(", ".join(known).rsplit(", ", 1))
        raise SarsplatError(f"{file} is no name for {what}; choose one that ends in {endings}")
    return content


def _refuse_others(file: Path, run: Path) -> None:
    """A slip must not cost the run, nor a file that is no export."""
    from sarsplat.data.files import open_file
    from sarsplat.data.mesh import MESH_FORMATS

    if Path(os.path.realpath(file)).is_relative_to(run.resolve()):
        raise SarsplatError(f"{file} is inside the run; choose a path outside {run}")
    if file.exists():
        kind = file.suffix.lower()
        with open_file(file) as content:
            if content.read(len(MESH_FORMATS[kind])) != MESH_FORMATS[kind]:
                raise SarsplatError(
                    f"{file} exists and is not a {kind} file as exported, so it will not be replaced; "
                    "choose another name"
                )
