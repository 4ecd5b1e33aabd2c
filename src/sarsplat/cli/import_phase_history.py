"""`sarsplat import phase-history`: pulses in, a dataset of focused images out."""

from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import numbers
from sarsplat.cli.from_signature import Option, comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, first_described


def _place(text: str, name: str) -> tuple[float, ...]:
    """Parse x, y and an optional height."""
    return (*numbers(text, name, (2, 3), "12,-7.5"), 0.0)[:3]


_AROUND = Annotated[str, tyro.conf.arg(metavar="X,Y[,Z]")]
command = command_of(
    __name__,
    "sarsplat.importers.phase_history_images:import_phase_history",
    around_m=Option(_AROUND, _place, default="0,0"),
    place=comma_separated("LAT,LON[,HAE]", (2, 3), "47.3769,8.5417"),
)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise files of a known format; of a folder, the first that can be read is described."""
    from sarsplat.importers.histories import FORMATS, format_of

    known = format_of(contents.path) if contents.path.is_file() else None
    if known is not None and known.begins:
        return _described(contents.path)  # or say what is wrong with it
    formats = FORMATS.loaded().values()
    found = first_described(contents.ending_in(*(ending for one in formats for ending in one.endings)), _described)
    certain = contents.ending_in(*(ending for one in formats if one.begins for ending in one.endings))
    return found or (_described(certain[0]) if certain else None)


def _described(path: Path) -> Recognised:
    from sarsplat.importers.histories import format_of, read_phase_history

    known = format_of(path)
    if known is not None and known.describe is not None:
        return Recognised(known.what, known.describe(path))
    read_phase_history(path)  # its ending may be that of many other things
    return Recognised("phase history")
