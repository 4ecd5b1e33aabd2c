"""Which commands there are, and how their words are read."""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial, wraps
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import tyro

from sarsplat import cli
from sarsplat.cli.arguments import MARKERS
from sarsplat.cli.check import check
from sarsplat.cli.compare import compare
from sarsplat.cli.completion import completion
from sarsplat.cli.doctor import doctor
from sarsplat.cli.evaluate import evaluate
from sarsplat.cli.export import export
from sarsplat.cli.info import info
from sarsplat.cli.mistakes import Level, explained
from sarsplat.cli.reconstruct import reconstruct
from sarsplat.cli.render import render
from sarsplat.cli.report import report
from sarsplat.cli.simulate import simulate
from sarsplat.cli.view import view
from sarsplat.errors import SarsplatError


def _importers() -> dict[str, Callable[..., None]]:
    """`import SOME-NAME` is the function `import_SOME_NAME` of the module of that name in this folder."""
    found = sorted(info.name for info in iter_modules(cli.__path__) if info.name.startswith("import_"))
    return {
        name.removeprefix("import_").replace("_", "-"): getattr(import_module(f"{cli.__name__}.{name}"), name)
        for name in found
    }


COMMANDS: dict[str, Callable[..., int | None] | dict[str, Callable[..., None]]] = {
    "simulate": simulate,
    "import": _importers(),
    "check": check,
    "reconstruct": reconstruct,
    "evaluate": evaluate,
    "report": report,
    "compare": compare,
    "render": render,
    "view": view,
    "export": export,
    "info": info,
    "doctor": doctor,
    "completion": completion,
}

_GROUPS = {"import": "Import measured images as a dataset."}
"""What the commands that have commands of their own are for."""

_DESCRIPTION = "From SAR images to a 3D target and back: simulate or import → reconstruct → evaluate → render."


def parse(words: Sequence[str]) -> Callable[[], int | None]:
    """The command that the words ask for, ready to be called; asked for help, it is printed and the process ends.

    What it returns is its exit code if that is not 0.

    Raises
    ------
    SarsplatError
        If they do not parse.
    """
    told = io.StringIO()
    try:
        with redirect_stderr(told):
            return _read(words)
    except SystemExit as end:
        if not end.code:
            raise
        raise SarsplatError(explained(words, told.getvalue(), options())) from None


def options() -> Level:
    """Commands and their options with their choices, as tyro lists them for shells."""
    script = io.StringIO()
    try:
        with redirect_stdout(script):
            _read(["--tyro-print-completion", "bash"])
    except SystemExit:
        pass
    found = re.search(r"^COMPLETION_SPEC = (.*)$", script.getvalue(), re.MULTILINE)
    assert found is not None
    level: Level = ast.literal_eval(found[1])
    return level


def _read(words: Sequence[str]) -> Callable[[], int | None]:
    called: Callable[[], int | None] = _app(COMMANDS, words).cli(
        prog="sarsplat", description=_DESCRIPTION, args=words, config=MARKERS
    )
    return called


def _app(commands: dict[str, Any], words: Sequence[str]) -> tyro.extras.SubcommandApp:
    app = tyro.extras.SubcommandApp()
    for name, command in commands.items():
        if isinstance(command, dict):
            app.command(_app(command, words), name=name, help=_GROUPS[name])
        else:
            app.command(name=name)(_later(command, words))
    return app


def _later(command: Callable[..., int | None], words: Sequence[str]) -> Callable[..., Callable[[], int | None]]:
    """The same signature, but not carried out yet; a command that has `words` gets those after its name."""

    @wraps(command)
    def bound(*arguments: Any, **options: Any) -> Callable[[], int | None]:
        if "words" in options:
            options["words"] = tuple(words[1:])
        return partial(command, *arguments, **options)

    return bound
