"""`sarsplat import phase-history`: pulses in, a dataset of focused images out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import numbers
from sarsplat.cli.from_signature import Option, comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, by_ending, first_readable


def _place(text: str, name: str) -> tuple[float, ...]:
    """The height may be left out."""
    return (*numbers(text, name, (2, 3), "12,-7.5"), 0.0)[:3]


_START = 128  # bytes
_TOLD = (b"CRSD", b"<CRSD", b"<CPHD")
"""What begins like this is no phase history, and is described all the same."""
_AROUND = Annotated[str, tyro.conf.arg(metavar="X,Y[,Z]")]
command = command_of(
    __name__,
    "sarsplat.importers.phase_history_images:import_phase_history",
    around_m=Option(_AROUND, _place, default="0,0"),
    place=comma_separated("LAT,LON[,HAE]", (2, 3), "47.3769,8.5417"),
)


def recognise(contents: Contents) -> Recognised | None:
    """A file that begins or ends as those of a known format do; of a folder, the first such that can be read.

    It is described if its format can be.
    """
    from sarsplat.data.files import open_file
    from sarsplat.importers.histories import FORMATS, format_of, what_else

    if contents.path.is_file():
        with open_file(contents.path) as file:
            start = file.read(_START)
        if start.lstrip().startswith(_TOLD) and (what := what_else(start)):
            return Recognised(what)
        known = format_of(contents.path)
        if known is not None and known.begins:
            return _recognised(contents, contents.path, known.what, _facts(contents.path))
    endings = [ending for one in FORMATS.loaded().values() for ending in one.endings]
    files = contents.ending_in(*endings)
    (first, facts), damaged = first_readable(files, _facts)
    if first is None or facts is None:
        known = format_of(files[0]) if files else None
        of_all = known is not None and known.begins  # no other is called or begins like that
        return _recognised(contents, files[0], known.what, damaged) if known and of_all else None
    known = format_of(first)
    named = {"the first": str(first)} if len(files) > 1 else {}
    what = known.what if known is not None and known.begins else None
    return _recognised(contents, first, what, (named if what else {}) | facts | damaged)


def _recognised(contents: Contents, first: Path, what: str | None, facts: dict[str, str]) -> Recognised | None:
    """Files with the ending of the first; `what` is their format's name, if nothing else begins like it."""
    found = by_ending(contents, (first.suffix.lower(),), "phase-history", "phase history")
    if found is None:
        return None
    return replace(found, facts=facts) if what is None else replace(found, kind=what, facts=facts, certainty=1.0)


def _facts(path: Path) -> dict[str, str]:
    """What a file of phase history holds, as far as its format can tell; refused if it is none, or damaged."""
    from sarsplat.importers.histories import format_of, read_phase_history

    known = format_of(path)
    if known is not None and known.begins:
        return {} if known.describe is None else known.describe(path)
    read_phase_history(path)  # its ending may be that of many other things
    return {}
