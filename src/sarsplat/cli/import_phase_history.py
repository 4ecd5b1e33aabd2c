"""`sarsplat import phase-history`: pulses in, a dataset of focused images out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import numbers
from sarsplat.cli.from_signature import Option, comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, by_ending
from sarsplat.errors import SarsplatError


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
    """A file that begins or ends as those of a known format do; of a folder, the first with such an ending, which is
    described if its format can be.
    """
    from sarsplat.data.files import open_file
    from sarsplat.importers.histories import FORMATS, format_of, what_else

    endings = [ending for one in FORMATS.loaded().values() for ending in one.endings]
    files = [contents.path] if contents.path.is_file() else contents.ending_in(*endings)
    if contents.path.is_file():
        with open_file(contents.path) as file:
            start = file.read(_START)
        if start.lstrip().startswith(_TOLD) and (what := what_else(start)):
            return Recognised(what)
    known = format_of(files[0]) if files else None
    if known is None or not (known.begins or _holds_pulses(files[0])):
        return None
    found = by_ending(contents, (files[0].suffix.lower(),), "phase-history", "phase history")
    if found is None or not known.begins:
        return found
    facts = {} if len(files) == 1 else {"the first": str(files[0])}
    try:
        facts |= {} if known.describe is None else known.describe(files[0])
    except SarsplatError as error:
        if contents.path.is_file():
            raise
        facts = {"the first": str(error)}
    return replace(found, kind=known.what, facts=facts, certainty=1.0)


def _holds_pulses(path: Path) -> bool:
    """Whether a file can be read as phase history: its ending may be that of many other things."""
    from sarsplat.importers.histories import read_phase_history

    try:
        read_phase_history(path)
    except SarsplatError:
        return False
    return True
