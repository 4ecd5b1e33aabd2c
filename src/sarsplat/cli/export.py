"""`sarsplat export`: a run in, one file for other programs out."""

from __future__ import annotations

from typing import Literal

from sarsplat.cli import console
from sarsplat.cli.arguments import File, RunFolder, refuse_existing


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
        Folder that `sarsplat reconstruct` made.
    out
        File to make.
    format
        ply: Gaussians, as 3D Gaussian splatting programs read them; points: the reconstructed surface points, metres.
    overwrite
        Replace an existing file.
    """
    from sarsplat.data import write_gaussians_ply, write_points_ply
    from sarsplat.reconstruct import Run

    done = Run.load(run)
    refuse_existing(out, overwrite)
    if format == "ply":
        gaussians = done.gaussians
        write_gaussians_ply(out, gaussians)
        console.finish(f"{out}: {len(gaussians)} Gaussians", f"open {out} in any 3D Gaussian splatting viewer")
    else:
        write_points_ply(out, done.points)
        console.finish(f"{out}: {len(done.points)} points, metres", f"open {out} in any point cloud or mesh viewer")
