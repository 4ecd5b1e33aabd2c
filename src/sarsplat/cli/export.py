"""`sarsplat export`: a run in, one file for other programs out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from sarsplat.cli import console
from sarsplat.cli.arguments import File, RunFolder, refuse_existing
from sarsplat.errors import SarsplatError


def export(
    run: RunFolder,
    *,
    out: File,
    format: Literal["ply", "points"] = "ply",
    overwrite: bool = False,
) -> None:
    """Write a run's Gaussians or points to one PLY file.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
    out
        File to write.
    format
        ply: Gaussians, in the layout of 3D Gaussian splatting; points: the reconstructed surface points, metres.
    overwrite
        Replace an existing PLY file.
    """
    from sarsplat.data import write_gaussians_ply, write_points_ply
    from sarsplat.reconstruction import Run

    done = Run.load(run)
    refuse_existing(out, overwrite)
    _refuse_others(out, run)
    if format == "ply":
        gaussians = done.gaussians
        write_gaussians_ply(out, gaussians)
        console.finish(f"{out}: {len(gaussians)} Gaussians", f"open {out} in any 3D Gaussian splatting viewer")
    else:
        write_points_ply(out, done.points)
        console.finish(f"{out}: {len(done.points)} points, metres", f"open {out} in any point cloud or mesh viewer")


def _refuse_others(out: Path, run: Path) -> None:
    """A slip must not cost the run, nor a file that is no export."""
    from sarsplat.data.files import open_file

    if Path(os.path.realpath(out)).is_relative_to(run.resolve()):
        raise SarsplatError(f"{out} is inside the run; choose a path outside {run}")
    if out.exists():
        with open_file(out) as file:
            if file.read(3) != b"ply":
                raise SarsplatError(
                    f"{out} exists and is not a PLY file, so it will not be replaced; choose another name"
                )
