"""Which commands there are, and how their words are read."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from functools import partial, wraps
from typing import Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import MARKERS
from sarsplat.cli.check import check
from sarsplat.cli.chips import chips
from sarsplat.cli.compare import compare
from sarsplat.cli.doctor import doctor
from sarsplat.cli.evaluate import evaluate
from sarsplat.cli.export import export
from sarsplat.cli.importers import IMPORTERS
from sarsplat.cli.info import info
from sarsplat.cli.mistakes import explained
from sarsplat.cli.reconstruct import reconstruct
from sarsplat.cli.render import render
from sarsplat.cli.report import report
from sarsplat.cli.simulate import simulate
from sarsplat.cli.sweep import sweep
from sarsplat.cli.view import view
from sarsplat.errors import SarsplatError

Command = Callable[..., int | None]


def completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> None:
    """Print a shell script that completes commands, options, presets, targets and paths.

    Parameters
    ----------
    shell
        The shell to complete in.
    """
    with suppress(SystemExit):
        _reader(["--tyro-write-completion", shell, "-"])()
    if shell == "bash":
        print("complete -o default -F _tyro_sarsplat sarsplat  # paths where nothing else is offered")


COMMANDS: dict[str, Command | Mapping[str, Command]] = {
    "simulate": simulate,
    "import": IMPORTERS,
    "check": check,
    "reconstruct": reconstruct,
    "evaluate": evaluate,
    "report": report,
    "compare": compare,
    "sweep": sweep,
    "render": render,
    "chips": chips,
    "view": view,
    "export": export,
    "info": info,
    "doctor": doctor,
    "completion": completion,
}
"""Commands by name; those of `import` are found."""

console.COMMANDS[:] = COMMANDS

_GROUPS = {"import": "Import measured images as a dataset."}
"""What the commands that have commands of their own are for."""

_DESCRIPTION = (
    "From SAR images to a 3D target and back: simulate or import → reconstruct → evaluate → render. "
    "`sarsplat COMMAND --help` explains a command, `sarsplat --version` prints the version."
)


def parse(words: Sequence[str]) -> Callable[[], int | None]:
    """The command that the words ask for, ready to be called; asked for help, it is printed and the process ends.

    What it returns is its exit code if that is not 0.

    Raises
    ------
    SarsplatError
        If they do not parse.
    """
    read, box = _reader(words), io.StringIO()
    try:
        with redirect_stderr(box):
            return read()
    except SystemExit as end:
        if not end.code:
            raise
        raise SarsplatError(explained(words, box.getvalue(), COMMANDS)) from None


def _reader(words: Sequence[str]) -> Callable[[], Callable[[], int | None]]:
    return partial(_app(COMMANDS, words).cli, prog="sarsplat", description=_DESCRIPTION, args=words, config=MARKERS)


def _app(commands: Mapping[str, Any], words: Sequence[str]) -> tyro.extras.SubcommandApp:
    app = tyro.extras.SubcommandApp()
    for name, command in commands.items():
        if name not in _GROUPS:
            app.command(name=name)(_later(command, words))
        elif words and words[0] in (name, "--tyro-write-completion"):
            app.command(_app(command.loaded(), words), name=name, help=_GROUPS[name])
        else:
            app.command(name=name, help=_GROUPS[name])(_nothing)  # no plugin is imported
    return app


def _nothing() -> None:
    """In place of commands that the words do not ask for."""


def _later(command: Command, words: Sequence[str]) -> Callable[..., Callable[[], int | None]]:
    """The same signature, but not carried out yet; a command that has `words` gets those after its name."""

    @wraps(command)
    def bound(*arguments: Any, **options: Any) -> Callable[[], int | None]:
        if "words" in options:
            options["words"] = tuple(words[1:])
        return partial(command, *arguments, **options)

    return bound
