"""`sarsplat evaluate`: a run in, scores out."""

from __future__ import annotations

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFolder, RunFolder


def evaluate(run: RunFolder, *, lpips_weights: OptionalFolder = None) -> None:
    """Score a run on unseen views and against the true surface, and write its report.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
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
    metrics = evaluate_run(done, lpips_weights=lpips_weights)
    with console.busy("writing the report"):
        page = write_report(done)
    paper = paper_beside(done.dataset)
    yardstick = Yardstick(metrics["parameters"]["yardstick_m"])
    console.show(metrics_table(comparison(metrics, paper), yardstick, NOT_THE_SAME_EXPERIMENT if paper else None))
    console.finish(f"{run / 'metrics.json'} and {page}", f"open {page} in a browser")
