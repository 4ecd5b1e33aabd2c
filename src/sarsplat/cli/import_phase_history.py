"""`sarsplat import phase-history`: pulses in, a dataset of focused images out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import numbers
from sarsplat.cli.from_signature import Option, command_of
from sarsplat.cli.importers import Contents, Recognised, by_ending
from sarsplat.errors import SarsplatError


def _place(text: str, name: str) -> tuple[float, ...]:
    """The height may be left out."""
    return (*numbers(text, name, (2, 3), "12,-7.5"), 0.0)[:3]


_AROUND = Annotated[str, tyro.conf.arg(metavar="X,Y[,Z]")]
command = command_of(
    __name__,
    "sarsplat.importers.phase_history_images:import_phase_history",
    around_m=Option(_AROUND, _place, default="0,0"),
)


def recognise(contents: Contents) -> Recognised | None:
    """A file that begins as those of a known format do, or ends so and can be read; of a folder, the first of them."""
    from sarsplat.importers.histories import FORMATS, format_of

    endings = [ending for one in FORMATS.loaded().values() for ending in one.endings]
    files = [contents.path] if contents.path.is_file() else contents.ending_in(*endings)
    known = format_of(files[0]) if files else None
    if known is None or not (known.begins or _holds_pulses(files[0])):
        return None
    found = by_ending(contents, (files[0].suffix.lower(),), "phase-history", "phase history")
    return replace(found, kind=known.what, certainty=1.0) if found and known.begins else found


def _holds_pulses(path: Path) -> bool:
    """Whether a file can be read as phase history: its ending may be that of many other things."""
    from sarsplat.importers.histories import read_phase_history

    try:
        read_phase_history(path)
    except SarsplatError:
        return False
    return True
