"""`sarsplat import folder`: pictures and a table in, a dataset out."""

from typing import Annotated

import tyro

from sarsplat.cli.arguments import Lengths, pair
from sarsplat.cli.from_signature import Option, command_of
from sarsplat.cli.importers import Contents, Recognised
from sarsplat.errors import SarsplatError

_CERTAINTY = 0.1  # certainty that pictures with a table are radar images


def _named(words: tuple[str, ...], name: str) -> dict[str, str]:
    """Parse `az=aspect,graz=elev`; names may contain spaces, but no commas."""
    named = {}
    for word in filter(None, ",".join(words).split(",")):
        meaning, equals, column = word.partition("=")
        if not equals or not column:
            raise SarsplatError(f"--{name} {word!r} is not of the form MEANING=NAME, such as azimuth=heading")
        named[meaning.strip()] = column.strip()
    return named


_COLUMNS = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MEANING=NAME …", help_behavior_hint="(optional)")]
_WIDTH = "3 dB width, m: one number, or azimuth and range; without it, the pixel spacing."
OPTIONS = {
    "columns": Option(_COLUMNS, _named, default=()),
    "spacing_m": Option(
        Lengths, pair, default=(), help="Pixel spacing in the slant plane, m: one number, or azimuth and range."
    ),
    "resolution_m": Option(Lengths, pair, default=(), help=_WIDTH),
}
"""Options of pictures, single ones and those of stacks."""
command = command_of(__name__, "sarsplat.importers.folder:import_folder", reading="pictures from ", **OPTIONS)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise pictures with a table (CSV) of their angles."""
    return described(contents, stacks=False)


def described(contents: Contents, *, stacks: bool) -> Recognised | None:
    """Describe pictures with a table of views, or of the channels of `stacks`; None for others."""
    from sarsplat.data.csv_table import read_table
    from sarsplat.importers.columns import chosen_columns
    from sarsplat.importers.pictures import PICTURE_ENDINGS

    pictures, tables = contents.ending_in(*PICTURE_ENDINGS), contents.ending_in(".csv")
    if not pictures or len(tables) != 1:
        return None
    facts, columns = {"pictures": str(len(pictures)), "table": str(tables[0])}, dict[str, str]()
    try:
        table = read_table(tables[0], "a table with a row for each picture")
        columns = chosen_columns(table, {})
        facts["columns"] = ", ".join([f"{meaning} = {name}" for meaning, name in columns.items()] or table.columns)
    except SarsplatError as error:
        facts["table"] = str(error)
    if stacks != ("view" in columns and bool({"baseline", "polarisation"} & set(columns))):
        return None
    return Recognised(f"pictures{' of stacks' * stacks} with a table", facts, certainty=_CERTAINTY)
