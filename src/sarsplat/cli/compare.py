"""`sarsplat compare`: a table and a page that put evaluated runs side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFolder, refuse_existing
from sarsplat.errors import counted

if TYPE_CHECKING:
    from rich.table import Table

    from sarsplat.report import Comparison


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN …")],
    *,
    out: OptionalFolder = None,
    overwrite: bool = False,
) -> None:
    """Put evaluated runs side by side: a table of their scores, and a page with their images and points.

    Parameters
    ----------
    runs
        Folders written by `sarsplat reconstruct`, by any method, each with its scores (`sarsplat evaluate`).
    out
        Folder to write the page into; without it, only the table is printed.
    overwrite
        Replace an existing comparison.
    """
    from sarsplat import report
    from sarsplat.report.compare import PAGE
    from sarsplat.runs import Run
    from sarsplat.runs.run_folder import left_open

    if out is not None:
        refuse_existing(out, overwrite, marker=PAGE)
    comparison = report.compare([Run.load(run) for run in runs])
    console.show(_table(comparison))
    if comparison.caution:
        console.say(comparison.caution)
    for sentence in comparison.beaten:
        console.warn(sentence)
    for name, run in zip(comparison.names, comparison.runs, strict=True):
        if lacking := left_open(run.metrics or {}).get("missing"):
            console.say(f"{name}: {lacking}")
    if out is None:
        console.say(f"next: sarsplat compare {' '.join(map(str, runs))} --out FOLDER (images and points on one page)")
        return
    with console.busy(f"drawing {counted(len(runs), 'run')}"):
        page = report.write_comparison(comparison, out, overwrite=overwrite)
    console.finish(str(page), f"open {page} in a browser")


def _table(comparison: "Comparison") -> "Table":
    """A row for every metric, a column for every run and baseline; the best of a row has a star."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        caption=None if comparison.caution else "* best of its row",
        caption_justify="left",
    )
    table.add_column("")
    names = dict.fromkeys([*comparison.names, *(one.name for scores in comparison.tables for one in scores.columns)])
    for name in names:
        table.add_column(escape(name), justify="right", overflow="fold")
    for scores in comparison.tables:
        table.add_row(f"[bold]{escape(scores.title)}[/]")
        for row in scores.rows:
            cells = {
                cell.column.name: f"[bold]{cell.text} *[/]" if cell.best else f"{cell.text}  " for cell in row.cells
            }
            table.add_row(f"  {row.metric.title} {row.metric.arrow}", *(cells.get(name, "") for name in names))
        table.add_section()
    return table
