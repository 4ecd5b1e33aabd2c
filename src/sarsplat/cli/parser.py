"""Parsing of the command line; only the module of the command that is named is imported."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr
from functools import partial, wraps
from typing import Any

from sarsplat.cli.commands import COMMANDS, IMPORT_SUMMARY, Command, command, first_paragraph, show_overview, summary
from sarsplat.cli.mistakes import no_command, plain
from sarsplat.errors import SarsplatError

_DESCRIPTION = (
    "From SAR images to a 3D target and back: simulate or import → reconstruct → evaluate → render. "
    "`sarsplat COMMAND --help` explains a command, `sarsplat --version` prints the version."
)


def parse(words: Sequence[str]) -> Callable[[], int | None]:
    """The command that the words ask for, ready to be called; asked for help, it is printed and the process ends.

    What it returns is its exit code if that is not 0. A SarsplatError says why words do not parse.
    """
    name, rest = _chosen("sarsplat", _DESCRIPTION, words, COMMANDS, lambda: {one: summary(one) for one in COMMANDS})
    return _importer(rest) if name == "import" else _read(f"sarsplat {name}", command(name), rest)


def _importer(words: Sequence[str]) -> Callable[[], int | None]:
    from sarsplat.cli.importers import IMPORTERS

    def summaries() -> dict[str, str]:
        return {name: first_paragraph(importer.__doc__) for name, importer in IMPORTERS.loaded().items()}

    name, rest = _chosen("sarsplat import", IMPORT_SUMMARY, words, IMPORTERS, summaries)
    return _read(f"sarsplat import {name}", IMPORTERS[name], rest)


def _chosen(
    program: str,
    description: str,
    words: Sequence[str],
    names: Iterable[str],
    summaries: Callable[[], Mapping[str, str]],
) -> tuple[str, Sequence[str]]:
    """The first of the names among the words, and the words after it; prints help if that is asked for instead."""
    if words and words[0] in ("-h", "--help"):
        show_overview(program, description, summaries())
        raise SystemExit(0)
    plain_names = {name.replace("_", "-"): name for name in names}
    name = plain_names.get(words[0].replace("_", "-")) if words else None
    if name is None:
        raise SarsplatError(no_command(program, words, plain_names.values()))
    return name, words[1:]


def _read(program: str, command: Command, words: Sequence[str]) -> Callable[[], int | None]:
    import tyro  # here and not for the overview, for it takes as long as all of that

    from sarsplat.cli.arguments import MARKERS

    if {"-h", "--help"} & {*words}:
        words = ["--help"]  # tyro's would lack what stands before it
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            return tyro.cli(_later(command, words), prog=program, args=words, config=MARKERS)
    except SystemExit as end:
        if not end.code:
            raise
        raise SarsplatError(plain(program, box.getvalue())) from None


def _later(command: Command, words: Sequence[str]) -> Callable[..., Callable[[], int | None]]:
    """The same signature, but not carried out yet; a command that has `words` gets those after its name."""

    @wraps(command)
    def bound(*arguments: Any, **options: Any) -> Callable[[], int | None]:
        if "words" in options:
            options["words"] = tuple(words)
        return partial(command, *arguments, **options)

    return bound
