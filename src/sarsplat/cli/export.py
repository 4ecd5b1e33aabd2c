"""`sarsplat export`: write a run as one file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import RunOrFile, one_of, refuse_existing, run_at
from sarsplat.cli.beaten import warn_if_beaten
from sarsplat.names import Colour, Content


def export(
    run: RunOrFile,
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    *,
    format: Annotated[Content | None, one_of(Content)] = None,
    colour: Annotated[Colour | None, one_of(Colour, hint="(default: db)")] = None,
    overwrite: bool = False,
) -> None:
    """Write Gaussians, points or a mesh of a run to one file for other programs.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`, or a PLY or .splat file of Gaussians.
    file
        File to write. Its ending decides the format: .ply (Gaussians, unless --format says otherwise); .splat
        (Gaussians); .glb, .obj, .stl (a mesh); .las, .laz, .pcd, .xyz (points); .npz (all arrays, for numpy).
    format
        What a .ply file holds. gaussians: in the layout of 3D Gaussian splatting; points: of the surface, metres, with
        normals and γ⁰; mesh: triangles through the points, with normals and γ⁰ at the vertices.
    colour
        What viewers show of Gaussians: γ⁰ in decibels as grey (db), or the height as colours.
    overwrite
        Replace an existing file of the same kind.
    """
    from sarsplat import exports
    from sarsplat.data.folders import refuse_other_kinds

    kind, content = exports.format_of(file, format)
    done = run_at(run, strays=content not in ("points", "mesh"))  # nothing is as fine as the rest, and as wide as they
    warn_if_beaten(done.metrics)
    refuse_existing(file, overwrite)
    refuse_other_kinds(file, run, kind.recognises)
    with console.busy(f"writing {file}"):
        written = exports.export(done, file, format, colour=colour)
    console.finish(f"{file}: {written.summary}", f"open {file} with {written.opened_with}")
