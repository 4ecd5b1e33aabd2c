"""Help pages that list commands (`sarsplat`, `sarsplat import`), without tyro, which is slow to import."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.panel import Panel
from rich.table import Table


def show_overview(program: str, description: str, summaries: Mapping[str, str]) -> None:
    """Print what the words after `program` may be, each with what it is for."""
    console = Console(emoji=False)
    usage = f"usage: {program} [-h] {{{','.join(summaries)}}}"
    console.print(f"{usage}\n\n{description}\n", soft_wrap=True, highlight=False, markup=False)
    width = max(map(len, summaries))
    for title, rows in (("options", {"-h, --help": "show this help message and exit"}), ("commands", summaries)):
        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True, min_width=width)
        table.add_column(style="dim", overflow="fold")
        for name, text in rows.items():
            table.add_row(name, text)
        console.print(Panel(table, title=title, title_align="left", border_style="dim"))
