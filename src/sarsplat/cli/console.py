"""What the commands say, and where: results on stdout, complaints on stderr."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

_WIDEST = 200  # columns


def say(text: str) -> None:
    """One line on stdout."""
    _print(Console(), _safe(text))


def show(renderable: RenderableType) -> None:
    """A table on stdout; in a file it may be wider than a terminal."""
    console = Console()
    if not console.is_terminal:
        needed = Measurement.get(console, console.options.update(width=_WIDEST), renderable).maximum
        console = Console(width=max(console.width, min(needed, _WIDEST)))
    console.print(renderable)


def facts(title: str, rows: dict[str, str]) -> None:
    """A title, and below it names and values."""
    say(title)
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(f"  {_safe(name)}", _safe(value))
    show(table)


def finish(wrote: str, next_step: str) -> None:
    """How a command ends: what it wrote, and what to do next."""
    _print(Console(), f"[green]wrote[/] {_safe(wrote)}")
    _print(Console(), f"[dim]next:[/] {_safe(next_step)}")


def complain(text: str) -> None:
    """An error on stderr."""
    _print(Console(stderr=True), f"[bold red]error:[/] {_safe(text)}")


def warn(text: str) -> None:
    """A warning on stderr."""
    _print(Console(stderr=True), f"[yellow]warning:[/] {_safe(text)}")


@contextmanager
def busy(text: str) -> Iterator[None]:
    """A spinner on terminals, one line elsewhere, while work of unknown length goes on."""
    console = Console()
    if not console.is_terminal:
        say(f"{text} …")
        yield
        return
    with console.status(_safe(text)):
        yield


def _safe(text: str) -> str:
    """Foreign text as it may be shown: no markup, and no control characters for the terminal."""
    return escape("".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text))


def _print(console: Console, markup: str) -> None:
    # soft_wrap: paths and commands stay whole, to be copied
    console.print(markup, soft_wrap=True, highlight=False)
