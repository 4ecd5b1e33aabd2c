"""A table with a row for each picture: the picture's file, and what the columns say of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sarsplat.data.csv_table import CsvTable, Row, parsed, read_table
from sarsplat.data.orientation import SIDES
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.importers.columns import (
    LOOKS,
    PER_UNIT,
    Columns,
    chosen_columns,
    recognised,
    require,
    require_degrees,
)
from sarsplat.importers.files import files_in, listed_files, warn_caller
from sarsplat.importers.pictures import PICTURE_ENDINGS
from sarsplat.names import Quantity, Side

_ROUNDED_DEG = 1.0 + 1e-6
"""By which grazing and incidence angles of whole degrees may miss a right angle together."""


@dataclass(frozen=True)
class ListedPicture:
    """One row of the table, lengths in m and angles in degrees; None where no column says it, or the cell is empty."""

    name: str
    """As the table names it."""
    path: Path
    azimuth_deg: float | None
    """As it stands in the table; None if a heading stands there instead."""
    heading_deg: float | None
    """Of the radar's flight, as it stands in the table; also beside an azimuth, with which it must agree."""
    grazing_deg: float | None
    spacing_m: tuple[float | None, float | None]
    """Azimuth, range."""
    resolution_m: tuple[float | None, float | None]
    """Azimuth, range."""
    azimuth_std_deg: float | None
    split: str | None
    """"train" or "test…"."""
    looks_left: bool | None
    """Whether the radar looks to the left of its flight."""
    tilt_deg: float | None
    """By how much its azimuth axis rises above the level one."""
    scale: float | None
    """What the pixels are multiplied by; where the table says what they hold, 1 / dn-per-magnitude or dn-per-power."""
    offset: float | None
    """What is then added to them."""
    near: Side | None
    """Side that is near the radar."""
    view: str | None
    """Of a stack: rows of the same view are its channels."""
    baseline_rad: float | None
    """Of a stack: b/R of the pass."""
    polarisation: str | None
    """Of a stack: as it stands in the table, in capital letters."""


@dataclass(frozen=True)
class PictureTable:
    """All rows that have a picture, in the order of the table, and which columns say what."""

    path: Path
    columns: Columns
    target: str | None
    """The class that all of them show; None where no column says it."""
    pictures: tuple[ListedPicture, ...]

    @property
    def real(self) -> Quantity | None:
        """What real numbers in the pictures are, by the column of their scale; None if there is none."""
        known = [held[0] for meaning, held in PER_UNIT.items() if meaning in self.columns]
        return known[0] if known and "scale" not in self.columns else None


def read_picture_table(
    folder: Path,
    path: Path | None,
    named: Mapping[str, str],
    *,
    target_class: str | None = None,
    grazing: bool = True,
    spacing: bool = True,
    looking: bool = False,
    compass: bool = False,
) -> PictureTable:
    """Read a table (None: the only one in the folder) and find its pictures, in subfolders or not.

    `named` is that of `chosen_columns`; `target_class` is the one whose pictures are wanted; `grazing` and `spacing`
    say whether the table must have columns of these, `looking` whether it is known to which side the radar looks, and
    `compass` whether azimuths may count from north. Rows without a picture and pictures without a row are warned of.
    Refused if the table is missing, damaged or lacks a column, names a file twice, none that exists or one outside the
    folder, several classes are in it of which none is chosen, or a cell or a column is not what it should be.
    """
    inside = files_in(folder, "the pictures")
    table = read_table(_the_table(folder, inside) if path is None else path, "a table with a row for each picture")
    columns = chosen_columns(table, named)
    require(table, columns, grazing, spacing, looking)
    require_degrees(table, columns, compass)
    column = columns["file"]
    row_of: dict[Path, Row] = {}
    for row, picture in listed_files(folder, table, table.rows, column, of="picture", endings=PICTURE_ENDINGS):
        if (first := row_of.setdefault(picture, row)) is not row:
            raise SarsplatError(
                f"{table.path} has two rows for {shown(row[1][column])}, lines {first[0]} and {row[0]}; remove one"
            )
    every = {path for path in inside if path.suffix.lower() in PICTURE_ENDINGS}
    if unlisted := len(every - set(row_of)):
        warn_caller(f"{table.path} has no row for {counted(unlisted, 'picture')} in {folder}, left out")
    target = _one_class(table, columns, target_class, list(row_of.values()))
    wanted = {at: row for at, row in row_of.items() if target is None or row[1][columns["class"]] == target}
    heading = _heading(table, columns, named)
    pictures = (_listed(table, row, columns, heading, at) for at, row in _placed(table, columns, wanted).items())
    return PictureTable(table.path, columns, target, tuple(pictures))


def _placed(table: CsvTable, columns: Columns, rows: dict[Path, Row]) -> dict[Path, Row]:
    """The rows that say where the radar was: those whose azimuth is empty are left out, unless that is so of all."""
    if "azimuth" not in columns or "heading" in columns:
        return rows
    placed = {at: row for at, row in rows.items() if row[1][columns["azimuth"]]}
    if not placed or len(placed) == len(rows):
        return rows
    first = next(row for at, row in rows.items() if at not in placed)
    warn_caller(
        f"{table.path} has no azimuth ({columns['azimuth']}) for {counted(len(rows) - len(placed), 'picture')} of "
        f"{len(rows)} (the first in line {first[0]}), left out; fill in what you need"
    )
    return placed


def _one_class(table: CsvTable, columns: Columns, wanted: str | None, rows: list[Row]) -> str | None:
    """The class whose pictures are taken: a dataset shows one target."""
    if "class" not in columns:
        if wanted is not None:
            raise SarsplatError(
                f"{table.path} has no column of classes to choose {shown(wanted)} from; name it with --columns "
                "class=NAME, or leave out --class"
            )
        return None
    classes = list(dict.fromkeys(row[1][columns["class"]] for row in rows))
    if wanted in classes:
        return wanted
    names = ", ".join(name if name and name.isprintable() else shown(name) for name in classes[:20])
    if wanted is not None:
        raise SarsplatError(f"{table.path} has no picture of the class {shown(wanted)}; choose one of {names}")
    if len(classes) > 1:
        raise SarsplatError(
            f"{table.path} has pictures of {len(classes)} classes ({names}), and a dataset shows one; choose it with "
            "--class NAME"
        )
    return classes[0] or None


def _the_table(folder: Path, files: list[Path]) -> Path:
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    if len(tables) != 1:
        number = f"{len(tables)} tables (CSV)" if tables else "no table (CSV) of its pictures"
        raise SarsplatError(f"{folder} has {number}; name it with --table")
    return tables[0]


def _heading(table: CsvTable, columns: Columns, named: Mapping[str, str]) -> str | None:
    """The column of headings: they count beside azimuths, too, unless only the column of these was named."""
    if "heading" in columns or {"azimuth", "az"} & set(named):
        return columns.get("heading")
    return recognised(table, "heading", columns)


def _listed(table: CsvTable, row: Row, columns: Columns, heading: str | None, path: Path) -> ListedPicture:
    def text(meaning: str) -> str:
        return row[1][columns[meaning]] if meaning in columns else ""

    def number(meaning: str) -> float | None:
        return table.number(row, columns[meaning]) if text(meaning) else None

    def pair(meaning: str) -> tuple[float | None, float | None]:
        both = number(meaning)
        azimuth, slant = number(f"azimuth-{meaning}"), number(f"range-{meaning}")
        return (both if azimuth is None else azimuth), (both if slant is None else slant)

    _refuse_other_sum(table, row, columns)
    grazing, incidence = number("grazing"), number("incidence")
    return ListedPicture(
        name=text("file"),
        path=path,
        azimuth_deg=table.direction(row, columns["azimuth"]) if "azimuth" in columns else None,
        heading_deg=_heading_deg(table, row, columns, heading),
        grazing_deg=90 - incidence if grazing is None and incidence is not None else grazing,
        spacing_m=pair("spacing"),
        resolution_m=pair("resolution"),
        azimuth_std_deg=number("azimuth-std"),
        split=_split(table, row, text("split")),
        looks_left=_looks_left(table, row, text("look")),
        tilt_deg=number("tilt"),
        scale=_scale(table, row, columns),
        offset=number("offset"),
        near=near_side(table, row, columns["near-side"]) if text("near-side") else None,
        view=text("view") or None,
        baseline_rad=number("baseline"),
        polarisation=text("polarisation").upper() or None,
    )


def _heading_deg(table: CsvTable, row: Row, columns: Columns, heading: str | None) -> float | None:
    if heading is None or ("azimuth" in columns and not math.isfinite(parsed(row[1][heading], table.decimal_comma))):
        return None
    return table.direction(row, heading)


def _refuse_other_sum(table: CsvTable, row: Row, columns: Columns) -> None:
    """Of a table with both, grazing and incidence angles must be the same: then it does not matter which is taken.

    Above the curved earth they are not if what is called grazing is a depression or an elevation at the radar.
    """
    if not {"grazing", "incidence"} <= columns.keys():
        return
    names = columns["grazing"], columns["incidence"]
    if not all(row[1][name] for name in names):
        return
    grazing, incidence = (table.number(row, name) for name in names)
    if abs(grazing + incidence - 90) > _ROUNDED_DEG:
        raise SarsplatError(
            f"{table.path}, line {row[0]}: {names[0]} is {grazing:g}° and {names[1]} is {incidence:g}°, which do not "
            f"add to 90°; say which of them holds at the target with --columns grazing={names[0]} or "
            f"--columns incidence={names[1]}"
        )


def _scale(table: CsvTable, row: Row, columns: Columns) -> float | None:
    """What a row's pixels are multiplied by; one that says nothing is refused if others do: all must compare."""
    if "scale" in columns:
        return table.number(row, columns["scale"]) if row[1][columns["scale"]] else None
    column = next((columns[one] for one in PER_UNIT if one in columns), None)
    if column is None or not any(cells[column] for _, cells in table.rows):
        return None
    if (numbers := table.number(row, column)) <= 0:
        raise SarsplatError(f"{table.path}, line {row[0]}: {column} is {numbers:g}; it must be a positive number")
    return 1 / numbers


def _split(table: CsvTable, row: Row, text: str) -> str | None:
    name = text.lower()
    if name in ("train", "training"):
        return "train"
    if not name or name.startswith("test"):
        return name or None
    raise SarsplatError(
        f"{table.path}, line {row[0]}: the set is {shown(text)}; it must be train, or a name that starts with test"
    )


def _looks_left(table: CsvTable, row: Row, text: str) -> bool | None:
    if text and text.lower() not in LOOKS:
        raise SarsplatError(f"{table.path}, line {row[0]}: the look side is {shown(text)}; it must be left or right")
    return LOOKS[text.lower()] if text else None


def near_side(table: CsvTable, row: Row, column: str) -> Side:
    """The side that a cell names."""
    side = row[1][column].lower()
    if side not in SIDES:
        raise SarsplatError(
            f"{table.path}, line {row[0]}: {column} is {shown(row[1][column])}; it must be one of {', '.join(SIDES)}"
        )
    return side
