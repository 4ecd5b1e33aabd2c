"""A table with a row for each picture: the picture's file, and what the columns say of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sarsplat.data.csv_table import CsvTable, Row, read_table
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.importers.columns import Columns, chosen_columns, require
from sarsplat.importers.files import files_in, listed_files, warn_caller
from sarsplat.importers.pictures import PICTURE_ENDINGS

_SIDES = {"left": True, "l": True, "right": False, "r": False}


@dataclass(frozen=True)
class ListedPicture:
    """One row of the table, lengths in m and angles in degrees; None where no column says it, or the cell is empty."""

    name: str
    """As the table names it."""
    path: Path
    azimuth_deg: float
    """As it stands in the table."""
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
    scale: float | None
    """What the pixels are multiplied by."""
    offset: float | None
    """What is then added to them."""
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


def read_picture_table(
    folder: Path,
    path: Path | None,
    named: Mapping[str, str],
    *,
    target_class: str | None = None,
    grazing: bool = True,
    spacing: bool = True,
) -> PictureTable:
    """Read a table (None: the only one in the folder) and find its pictures, in subfolders or not.

    `named` is that of `chosen_columns`; `target_class` is the one whose pictures are wanted; `grazing` and `spacing`
    say whether the table must have columns of these. Rows without a picture and pictures without a row are warned of.

    Raises
    ------
    SarsplatError
        If the table is missing, damaged or lacks a column, names a file twice, none that exists or one outside the
        folder, several classes are in it of which none is chosen, or a cell is not what its column should hold.
    """
    inside = files_in(folder, "the pictures")
    table = read_table(_the_table(folder, inside) if path is None else path, "a table with a row for each picture")
    columns = chosen_columns(table, named)
    require(table, columns, grazing, spacing)
    column = columns["file"]
    row_of: dict[Path, Row] = {}
    for row, picture in listed_files(folder, table, table.rows, column, of="picture", endings=PICTURE_ENDINGS):
        if (first := row_of.setdefault(picture, row)) is not row:
            raise SarsplatError(
                f"{table.path} has two rows for {shown(row[1][column])}, lines {first[0]} and {row[0]}; remove one"
            )
    every = {path for path in inside if path.suffix.lower() in PICTURE_ENDINGS}
    if unlisted := len(every - set(row_of)):
        warn_caller(f"{table.path} has no row for {counted(unlisted, 'picture')} in {folder}, which are left out")
    target = _one_class(table, columns, target_class, list(row_of.values()))
    pictures = (
        _listed(table, row, columns, at)
        for at, row in row_of.items()
        if target is None or row[1][columns["class"]] == target
    )
    return PictureTable(table.path, columns, target, tuple(pictures))


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


def _listed(table: CsvTable, row: Row, columns: Columns, path: Path) -> ListedPicture:
    def text(meaning: str) -> str:
        return row[1][columns[meaning]] if meaning in columns else ""

    def number(meaning: str) -> float | None:
        return table.number(row, columns[meaning]) if text(meaning) else None

    def pair(meaning: str) -> tuple[float | None, float | None]:
        both = number(meaning)
        azimuth, slant = number(f"azimuth-{meaning}"), number(f"range-{meaning}")
        return (both if azimuth is None else azimuth), (both if slant is None else slant)

    incidence = number("incidence")
    return ListedPicture(
        name=text("file"),
        path=path,
        azimuth_deg=table.number(row, columns["azimuth"]),
        grazing_deg=number("grazing") if incidence is None else 90 - incidence,
        spacing_m=pair("spacing"),
        resolution_m=pair("resolution"),
        azimuth_std_deg=number("azimuth-std"),
        split=_split(table, row, text("split")),
        looks_left=_looks_left(table, row, text("look")),
        scale=number("scale"),
        offset=number("offset"),
        view=text("view") or None,
        baseline_rad=number("baseline"),
        polarisation=text("polarisation").upper() or None,
    )


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
    if text and text.lower() not in _SIDES:
        raise SarsplatError(f"{table.path}, line {row[0]}: the look side is {shown(text)}; it must be left or right")
    return _SIDES[text.lower()] if text else None
