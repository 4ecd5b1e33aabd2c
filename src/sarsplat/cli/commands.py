"""The list of commands and their summaries, which are read without importing any command."""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

COMMANDS = (
    *("simulate", "import", "check", "reconstruct", "evaluate", "report", "compare", "sweep", "render", "chips"),
    *("view", "export", "info", "doctor", "completion"),
)
"""In the order of help: each is a function in the file of its name in this folder, but `import`, which has commands."""

IMPORT_SUMMARY = "Import measured images as a dataset."


def command(name: str) -> Callable[..., int | None]:
    """The function that a command is."""
    function: Callable[..., int | None] = getattr(import_module(f"sarsplat.cli.{name}"), name)
    return function


def summary(name: str) -> str:
    """Summary of a command: the first paragraph of its function's docstring, read from the source."""
    if name == "import":
        return IMPORT_SUMMARY
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    functions = (node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef) and node.name == name)
    return first_paragraph(ast.get_docstring(next(functions)))


def first_paragraph(docstring: str | None) -> str:
    """What a docstring says before its first empty line, as one line."""
    return " ".join((docstring or "").partition("\n\n")[0].split())
