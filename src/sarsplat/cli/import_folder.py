"""`sarsplat import folder`: pictures and a table in, a dataset out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sarsplat.cli.arguments import Lengths, pair
from sarsplat.cli.from_signature import Option, command_of
from sarsplat.cli.importers import Contents, Recognised, dataset_name, typed_import
from sarsplat.errors import SarsplatError, counted

if TYPE_CHECKING:
    from sarsplat.importers.columns import Columns


_LEAST_CERTAIN = 0.1
"""Pictures may be anything's."""

_LISTED = 5
"""Tables and variables that are named."""

_ARRAYS = {".mat": "a MATLAB file", ".npy": "a NumPy file", ".tif": "a TIFF", ".tiff": "a TIFF"}
"""Files that may hold a picture, by their endings."""
_NARROWEST = 8
"""Pixels on a side of a picture: what is narrower is a table of points or angles."""


def _named(words: tuple[str, ...], name: str) -> dict[str, str]:
    """`az=aspect,graz=elev` as a mapping; names may contain spaces, but no commas."""
    named = {}
    for word in filter(None, ",".join(words).split(",")):
        meaning, equals, column = word.partition("=")
        if not equals or not column:
            raise SarsplatError(f"--{name} {word!r} is not of the form MEANING=NAME, such as azimuth=heading")
        named[meaning.strip()] = column.strip()
    return named


_COLUMNS = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MEANING=NAME …", help_behavior_hint="(optional)")]
command = command_of(
    __name__,
    "sarsplat.importers.folder:import_folder",
    reading="pictures from ",
    columns=Option(_COLUMNS, _named, default=()),
    spacing_m=Option(
        Lengths, pair, default=(), help="Pixel spacing in the slant plane, m: one number, or azimuth and range."
    ),
    resolution_m=Option(
        Lengths,
        pair,
        default=(),
        help="3 dB width, m: one number, or azimuth and range; without it, the pixel spacing.",
    ),
)


def recognise(contents: Contents) -> Recognised | None:
    """Pictures, with or without a table of their angles."""
    from sarsplat.importers.pictures import PICTURE_ENDINGS
    from sarsplat.importers.tiffs import TIFF, is_plain_tiff_of_others

    pictures = len(contents.ending_in(*PICTURE_ENDINGS))
    ending = contents.path.suffix.lower()
    if contents.path.is_file() and ending in _ARRAYS and (ending not in TIFF or is_plain_tiff_of_others(contents.path)):
        return _arrays(contents.path)
    if not pictures or not contents.path.is_dir():
        return None
    tables = contents.ending_in(".csv")
    with_table = _with_table(contents, pictures, tables[0]) if len(tables) == 1 else None
    return with_table or _without_table(contents, pictures, PICTURE_ENDINGS, tables)


def _arrays(path: Path) -> Recognised:
    """A file of arrays, which may be anything's: what is in it, and how to import it if it is a picture's."""
    from sarsplat.importers.mat import read_mat
    from sarsplat.importers.pictures import read_picture

    if path.suffix.lower() == ".mat":
        arrays = {name: value for name, value in read_mat(path).items() if value is not None}
        facts = {name: _described(value) for name, value in list(arrays.items())[:_LISTED]}
        facts |= {"…": counted(len(arrays) - _LISTED, "more variable")} if len(arrays) > _LISTED else {}
    else:
        facts = {}
    kind = _ARRAYS[path.suffix.lower()]
    try:
        pixels = read_picture(path)[0]
    except SarsplatError as error:
        return Recognised(
            f"{kind}, which is no picture that can be imported",
            facts | {"as a picture": str(error)},
            certainty=_LEAST_CERTAIN,
        )
    facts = facts or {"array": _described(pixels)}
    if min(pixels.shape[:2] if pixels.shape[-1] == 2 else pixels.shape[-2:]) < _NARROWEST:
        return Recognised(f"{kind}, which holds no picture that can be imported", facts, certainty=_LEAST_CERTAIN)
    words = ("folder", str(path.parent), "--table", "TABLE.csv", "--spacing", "METRES", *_quantity([path]))
    command = typed_import(*words, out=dataset_name(path.parent))
    return Recognised(f"{kind}, which may be a picture", facts, command, certainty=_LEAST_CERTAIN)


def _quantity(pictures: Sequence[Path]) -> list[str]:
    """The option that says what the numbers of pictures are, if the first that can be read does not say it."""
    from sarsplat.importers.pictures import likely_quantity, read_pixels

    for path in pictures:
        try:
            pixels = read_pixels(path)
        except SarsplatError:
            continue  # which the import says
        try:
            likely_quantity(pixels, str(path))
        except SarsplatError:
            return ["--quantity", "QUANTITY"]
        return []
    return []


def _described(value: object) -> str:
    import numpy as np

    if isinstance(value, np.ndarray):
        return f"{' × '.join(map(str, value.shape))} numbers, {value.dtype.name}"
    return f"a record of {', '.join(list(value)[:_LISTED])}" if isinstance(value, dict) else "something else"


def _with_table(contents: Contents, pictures: int, path: Path) -> Recognised:
    """Pictures and a table, which may lack columns or not be readable."""
    from sarsplat.data.csv_table import read_table
    from sarsplat.importers.columns import chosen_columns
    from sarsplat.importers.pictures import PICTURE_ENDINGS
    from sarsplat.importers.tiffs import first_georeference

    facts = {"pictures": str(pictures)}
    try:
        table = read_table(path, "a table with a row for each picture")
        columns = chosen_columns(table, {})
    except SarsplatError as error:
        facts["table"] = str(error)
        return Recognised("pictures with a table that cannot be used as it is", facts, certainty=_LEAST_CERTAIN)
    facts["table"] = f"{table.path} ({counted(len(table.rows), 'row')})"
    if columns:
        facts["columns"] = ", ".join(f"{meaning} = {name}" for meaning, name in columns.items())
    lacking = [meaning for meaning in ("file", "azimuth") if meaning not in columns]
    if "heading" in columns and "azimuth" in lacking:
        lacking.remove("azimuth")
    if lacking:
        facts["missing"] = f"which column is the {' and which the '.join(lacking)}; it has {', '.join(table.columns)}"
    classes = dict.fromkeys(row[columns["class"]] for _, row in table.rows) if "class" in columns else {}
    if len(classes) > 1:
        facts["classes"] = ", ".join(classes)
    views = [row[columns["view"]] for _, row in table.rows] if "view" in columns else []
    stacks = bool(columns.keys() & {"baseline", "polarisation"}) and len(set(views)) < len(views)
    if stacks:
        facts["stacks"] = f"{counted(len(set(views)), 'view')} of several channels"
    lies = first_georeference(contents.files)
    if lies is not None:
        at = f"on a map, {lies.system}: geocoded" if lies.on_map else "in no map's system"
        facts["GeoTIFF"] = f"{at}, pixels of {lies.pixel} (columns × rows)"
    more = [] if lies is None else ["--geocoded", "GROUND", "--resolution", "METRES"] * lies.on_map
    target_class = next(iter(classes)) if len(classes) > 1 else None
    named = [contents.path / row[columns["file"]] for _, row in table.rows] if "file" in columns else []
    inside = set(contents.files)
    pictures_of = [*(one for one in named if one in inside), *contents.ending_in(*PICTURE_ENDINGS)]
    of_map = more if lies is not None else None
    command = _command(contents.path, columns, lacking, target_class, stacks, of_map, pictures_of)
    certainty = 1.0 if not lacking else 0.2 if columns else _LEAST_CERTAIN
    return Recognised(f"pictures with a table{'' if lacking else ' of their angles'}", facts, command, certainty)


def _command(
    folder: Path,
    columns: Columns,
    lacking: list[str],
    target_class: str | None,
    stacks: bool,
    of_map: list[str] | None,
    pictures: Sequence[Path],
) -> str:
    """What to type; `of_map` is what GeoTIFFs need, None if there are none, and then a spacing is needed."""
    from sarsplat.importers.columns import PER_UNIT

    words = ["folder", str(folder)]
    if target_class is not None:
        words += ["--class", target_class]
    if lacking:
        words += ["--columns", ",".join(f"{meaning}=NAME" for meaning in lacking)]
    if not columns.keys() & {"grazing", "incidence"}:
        words += ["--grazing", "DEGREES"]
    elif not columns.keys() & PER_UNIT.keys():
        words += _quantity(pictures)
    if of_map is None and not any("spacing" in meaning for meaning in columns):
        words += ["--spacing", "METRES"]
    if "heading" in columns and "look" not in columns:
        words += ["--look", "SIDE"]
    if stacks:
        words += ["--wavelength", "METRES"]
    return typed_import(*words, *(of_map or []), out=dataset_name(folder))


def _without_table(contents: Contents, pictures: int, endings: tuple[str, ...], tables: list[Path]) -> Recognised:
    numbers = {ending: len(contents.ending_in(ending)) for ending in endings}
    kinds = ", ".join(f"{number} {ending}" for ending, number in numbers.items() if number)
    columns = "the columns file, azimuth, grazing, spacing (docs/reference/formats/folder.md)"
    needed = f"a table (CSV) with a row for each, with {columns}"
    if tables:
        needed = f"which of {len(tables)} tables is theirs: {', '.join(map(str, tables[:_LISTED]))}"
        needed += ", …" * (len(tables) > _LISTED)
    files = contents.ending_in(*endings)
    words = ("folder", str(contents.path), "--table", "TABLE.csv", "--spacing", "METRES", *_quantity(files))
    return Recognised(
        f"{counted(pictures, 'picture')} ({kinds}) without a table of their angles",
        {"missing": needed},
        typed_import(*words, out=dataset_name(contents.path)),
        certainty=_LEAST_CERTAIN,
    )
