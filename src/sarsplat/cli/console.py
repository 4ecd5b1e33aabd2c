"""Terminal output of the commands: results on stdout, errors and warnings on stderr."""

import ast
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from sarsplat.cli.commands import COMMANDS

_WIDEST = 200  # columns

_QUOTED = r"`(?P<name>[a-z][a-z0-9_.]+)(?:=(?P<value>[^`]*))?`"
_BARE = r"(?<![\w./=,-])(?P<bare>[a-z][a-z0-9_]+)=(?P<literal>True|False|None|'[^']*'|\"[^\"]*\")(?!\w|[/.,]\S)"
"""Python parameters in messages: `name` or `name=value` in backquotes; name=True, =False, =None or ='text' without."""

_RENAMED = {
    "alignment": "align",
    "azimuths_deg": "azimuth",
    "content": "format",
    "ground_gamma0": "ground",
    "target_class": "class",
}
"""Options that are not named like the library's parameters, besides units."""

_SPECIAL = {"calibration='absolute'": "--calibrated", "looks=None": "--looks 0"}
_PYTHON_ONLY = ("allow_empty", "create_graph", "engine", "initial", "name", "plane_gradients")
_COMMA_SEPARATED = ("around", "pixel", "place")


def say(text: str) -> None:
    """Print a line."""
    _print(Console(), _safe(text))


def show(renderable: RenderableType) -> None:
    """Print a table; in a file it may be wider than a terminal."""
    console = Console()
    if not console.is_terminal:
        needed = Measurement.get(console, console.options.update(width=_WIDEST), renderable).maximum
        console = Console(width=max(console.width, min(needed, _WIDEST)))
    console.print(renderable)


def facts(title: str, rows: dict[str, str]) -> None:
    """Print a title, and below it names and values."""
    say(title)
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(f"  {_safe(name)}", _safe(value))
    show(table)


def finish(wrote: str, next_step: str | None) -> None:
    """Print the output of a command and the next step, None if it is printed later."""
    _print(Console(), f"[green]wrote[/] {_safe(wrote)}")
    if next_step is not None:
        _print(Console(), f"[dim]next:[/] {_safe(next_step)}")


def program() -> str:
    """Return the name of `sarsplat` in the calling shell: its path where the shell does not find it by name."""
    called = Path(sys.argv[0])
    if called.name == "__main__.py" and called.parent.name == "sarsplat":
        on_path = shutil.which("python")
        # by folder: the pythons of all environments are links to one file
        same = on_path is not None and Path(on_path).absolute().parent == Path(sys.executable).parent
        python = "python" if same else _near(Path(sys.executable))
        return f"{python} -m sarsplat"
    if called.stem != "sarsplat" or not called.is_file():
        return "sarsplat"  # called from Python by another program
    on_path = shutil.which("sarsplat")
    return "sarsplat" if on_path and Path(on_path).samefile(called) else _near(called)


def _near(path: Path) -> str:
    """Return a program's path for a shell, relative if it lies in the current folder."""
    near = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return shlex.quote(str(near) if len(near.parts) > 1 else f".{os.sep}{near}")


def complain(text: str) -> None:
    """Print an error on stderr."""
    _print(Console(stderr=True), f"[bold red]error:[/] {_safe(as_options(text))}")


def warn(text: str) -> None:
    """Print a warning on stderr."""
    _print(Console(stderr=True), f"[yellow]warning:[/] {_safe(as_options(text))}")


@contextmanager
def busy(text: str) -> Iterator[None]:
    """Show a spinner on terminals, print one line elsewhere, during work of unknown length."""
    console = Console()
    if not console.is_terminal:
        say(f"{text} …")
        yield
        return
    with console.status(_safe(text)):
        yield


def _safe(text: str) -> str:
    """Escape markup and control characters; word parameters in backquotes as options, and `sarsplat` as in a shell."""
    worded = _typed(as_options(text, _QUOTED))  # paths may look like bare ones
    return escape("".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in worded))


def option_name(parameter: str) -> str:
    """Return the option of a parameter, without its hyphens in front: `target_box_m` is target-box."""
    plain = parameter if "." in parameter else re.sub(r"_(m|deg)$", "", parameter)  # settings are dotted
    return _RENAMED.get(parameter, plain.replace("_", "-"))


def as_options(text: str, parameters: str = f"{_QUOTED}|{_BARE}") -> str:
    """Word the parameters in a message of the library as options: `ground=False` is --no-ground."""
    return re.sub(parameters, _as_option, text)


def _as_option(found: re.Match[str]) -> str:
    groups = found.groupdict()
    parameter, value = groups["name"] or groups["bare"], groups["value"] or groups.get("literal")
    if parameter in _PYTHON_ONLY:
        return found[0]
    if value is not None and (special := _SPECIAL.get(f"{parameter}={value}")) is not None:
        return special
    name = option_name(parameter)
    match value:
        case None | "True":
            return f"--{name}"
        case "False":
            return f"--no-{name}"
        case "None":
            return f"--{name} off"
    try:
        literal = ast.literal_eval(value)
    except (SyntaxError, ValueError):  # a placeholder, such as NAME
        literal = re.sub(r"['\"(){}\[\]]", "", value).replace(": ", "=").split(", ")
    if isinstance(literal, dict):
        literal = [f"{key}={its}" for key, its in literal.items()]
    words = [shlex.quote(str(word)) for word in (literal if isinstance(literal, list | tuple) else [literal])]
    return f"--{name}={','.join(words)}" if name in _COMMA_SEPARATED else f"--{name} {' '.join(words)}"


def _typed(text: str) -> str:
    """Return the text with `program` in place of `sarsplat` before a command's name."""
    if "sarsplat " not in text or (called := program()) == "sarsplat":
        return text
    return re.sub(rf"(?<![\w./-])sarsplat(?= (?:{'|'.join(COMMANDS)})\b)", lambda _: called, text)


def _print(console: Console, markup: str) -> None:
    # soft_wrap: paths and commands stay whole, to be copied
    console.print(markup, soft_wrap=True, highlight=False)


def warn_if_beaten(metrics: Mapping[str, Any] | None) -> None:
    """Warn of every test set on which a baseline is better; skip scores of another version."""
    if metrics is None:
        return
    from sarsplat.evaluation import beaten_by_baselines

    try:
        sentences = beaten_by_baselines(metrics)
    except (KeyError, TypeError, AttributeError, ValueError):
        return
    for sentence in sentences:
        warn(sentence)
