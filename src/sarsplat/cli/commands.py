"""Commands and their summaries, read without importing any command, or tyro, which is slow."""

import ast
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import cleandoc
from pathlib import Path

from rich.console import Console
from rich.panel import Panel
from rich.table import Table

Command = Callable[..., int | None]

COMMANDS = (
    *("simulate", "import", "check", "reconstruct", "evaluate", "report", "compare", "sweep", "render", "chips"),
    *("locate", "view", "export", "info", "doctor", "completion"),
)
"""Commands in the order of help: each is a function in the file of its name here; `import` has commands itself."""

IMPORT_SUMMARY = "Import measured images as a dataset."


def command(name: str) -> Command:
    """Return the function of a command."""
    function: Command = getattr(import_module(f"sarsplat.cli.{name}"), name)
    function.__doc__ = unwrapped(function.__doc__)
    return function


def summary(name: str) -> str:
    """Return the first paragraph of a command's docstring, read from the source."""
    if name == "import":
        return IMPORT_SUMMARY
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    functions = (node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef) and node.name == name)
    return first_paragraph(ast.get_docstring(next(functions)))


def unwrapped(docstring: str | None) -> str:
    """Return a docstring with one line for each parameter: tyro would keep some line breaks."""
    return re.sub(
        r"^( {4,}).*\n(\1.*\n)+",
        lambda lines: lines[1] + " ".join(lines[0].split()) + "\n",
        cleandoc(docstring or ""),
        flags=re.MULTILINE,
    )


def first_paragraph(docstring: str | None) -> str:
    """Return a docstring up to its first empty line, as one line."""
    return " ".join((docstring or "").partition("\n\n")[0].split())


def show_overview(program: str, description: str, summaries: Mapping[str, str]) -> None:
    """Print the commands of `program` with their summaries."""
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
