"""`sarsplat evaluate`: a run in, scores out."""

from __future__ import annotations

from typing import Literal

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFile, OptionalFolder, RunFolder


def evaluate(
    run: RunFolder,
    *,
    mesh: OptionalFile = None,
    align: Literal["none", "rigid"] = "none",
    masks: OptionalFolder = None,
    lpips_weights: OptionalFolder = None,
) -> None:
    """Score a run on unseen views and against the true surface, and write its report.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
    mesh
        A model of the target to hold the points against, metres, in the frame of the views (x towards the nose, z up,
        ground at z = 0); without it, the dataset's true mesh, if it has one.
    align
        rigid: bring the points onto the visible surface first, by at most three resolution cells and 5° about the
        vertical. Where a measured target stands in its images says nothing about its reconstruction.
    masks
        Folder of true masks, grey PNGs with the names of the images (T72/17deg/hb03333.png): 0 clutter, 1 target,
        2 shadow; of MSTAR chips in the orientation as published, of others in that of the images.
    lpips_weights
        Folder of the LPIPS weights (default: SARSPLAT_LPIPS_WEIGHTS); without weights, LPIPS is skipped.
    """
    from sarsplat.evaluation import (
        NOT_THE_SAME_EXPERIMENT,
        Yardstick,
        comparison,
        evaluate_run,
        metrics_table,
        paper_beside,
    )
    from sarsplat.reconstruction import Run
    from sarsplat.report import write_report
    from sarsplat.report.write import refuse_linked_report

    done = Run.load(run)
    refuse_linked_report(run)
    metrics = evaluate_run(done, mesh=mesh, alignment=align, masks=masks, lpips_weights=lpips_weights)
    with console.busy("writing the report"):
        page = write_report(done)
    paper = paper_beside(done.dataset)
    yardstick = Yardstick(metrics["parameters"]["yardstick_m"])
    console.show(metrics_table(comparison(metrics, paper), yardstick, NOT_THE_SAME_EXPERIMENT if paper else None))
    console.finish(f"{run / 'metrics.json'} and {page}", f"open {page} in a browser")
