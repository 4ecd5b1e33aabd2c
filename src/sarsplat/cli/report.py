"""`sarsplat report`: write the report of a run."""

import shlex

from sarsplat.cli import console
from sarsplat.cli.arguments import RunFolder, trained_so_far


def report(run: RunFolder) -> None:
    """Write a run's report: pictures, scores and settings on one page that works offline.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
    """
    from sarsplat.report import write_report

    done = trained_so_far(run)
    page = write_report(done)
    evaluated = done.metrics is not None
    console.finish(
        str(page), f"open {page} in a browser" if evaluated else f"sarsplat evaluate {shlex.quote(str(run))}"
    )
