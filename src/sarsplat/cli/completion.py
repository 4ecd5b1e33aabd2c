"""`sarsplat completion`: a script for a shell, made from the options of all commands."""

from contextlib import suppress
from typing import Annotated, Literal

import tyro

from sarsplat.cli.arguments import MARKERS
from sarsplat.cli.commands import COMMANDS, command
from sarsplat.cli.importers import IMPORTERS


def completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> None:
    """Print a shell script that completes commands, options, presets, targets and paths.

    Parameters
    ----------
    shell
        The shell to complete in.
    """
    program, importers = tyro.extras.SubcommandApp(), tyro.extras.SubcommandApp()
    for name, importer in IMPORTERS.loaded().items():
        importers.command(name=name)(importer)
    for name in COMMANDS:
        if name == "import":
            program.command(importers, name=name)
        else:
            program.command(name=name)(command(name))
    with suppress(SystemExit):
        program.cli(prog="sarsplat", args=["--tyro-write-completion", shell, "-"], config=MARKERS)
    if shell == "bash":
        print("complete -o default -F _tyro_sarsplat sarsplat  # paths where nothing else is offered")
