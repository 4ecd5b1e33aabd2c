"""Table with a row for each picture: its file, and the contents of its columns."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, cast

from sarsplat.data.csv_table import CsvTable, Row, parsed, read_table
from sarsplat.data.orientation import SIDES
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.importers.about import AboutPictures
from sarsplat.importers.columns import (
    FACTORS,
    LOOKS,
    Columns,
    chosen_columns,
    converted,
    recognised,
    require,
    require_azimuths,
    unused_factor,
)
from sarsplat.importers.files import files_in, listed_files, warn_caller
from sarsplat.importers.pictures import PICTURE_ENDINGS
from sarsplat.importers.rasters import first_georeference
from sarsplat.names import Quantity, Side

_COLUMN = re.compile(r"\{([^{}]+)\}")  # a column in a pattern of names
_SCALES = 1e-15, 1e15  # least and largest scale of pixels; the square of no magnitude leaves float32
_PRODUCTS = {"manifest.safe": "SAFE (Sentinel-1)", "led-al": "CEOS (ALOS)"}
"""Beginnings of files' names, in small letters → layouts of satellites' products."""
_ROUNDED_DEG = 1.0 + 1e-6  # maximum difference from 90° of the sum of grazing and incidence angles in whole degrees


@dataclass(frozen=True)
class ListedPicture:
    """Row of the table, lengths in m and angles in degrees; None where there is no column, or the cell is empty."""

    name: str
    """Name of the picture in the table."""
    path: Path
    azimuth_deg: float | None
    """Azimuth in the table's convention; None if only a heading is given."""
    heading_deg: float | None
    """Heading of the radar's flight; beside an azimuth, both must agree."""
    grazing_deg: float | None
    spacing_m: tuple[float | None, float | None]
    """Azimuth, range."""
    resolution_m: tuple[float | None, float | None]
    """Azimuth, range."""
    azimuth_std_deg: float | None
    """Infinite if the azimuth is unknown."""
    split: str | None
    """"train" or "test…"."""
    looks_left: bool | None
    """True if the radar looks to the left of its flight."""
    tilt_deg: float | None
    """Angle by which its azimuth axis rises above the level one."""
    scale: float | None
    """Factor on the pixels."""
    power_factor: float | None
    """Factor on the power: of a column dn-per-magnitude, dn-per-power, scale-factor or calibration-factor."""
    offset: float | None
    """Number added to the scaled pixels."""
    near: Side | None
    """Side that is near the radar."""
    view: str | None
    """Name of the view in a stack: rows of the same view are its channels."""
    baseline_rad: float | None
    """b/R of the pass in a stack."""
    polarisation: str | None
    """Polarisation in a stack, in capital letters."""


@dataclass(frozen=True)
class PictureTable:
    """All rows that have a picture, in the order of the table, and the columns by their meaning."""

    path: Path
    columns: Columns
    target: str | None
    """Class of all pictures; None if no column states it."""
    pictures: tuple[ListedPicture, ...]

    @property
    def real(self) -> Quantity | None:
        """Quantity of real numbers in the pictures, by the column of their scale, or None."""
        known = [kinds[0] for meaning, (exponent, kinds) in FACTORS.items() if meaning in self.columns and exponent < 0]
        return known[0] if known and "scale" not in self.columns else None

    def refuse_unstated(self, what: str, picture: ListedPicture, remedy: str = "fill it in") -> NoReturn:
        """Raise for a picture whose row does not state something that is needed."""
        raise SarsplatError(f"{self.path} does not state the {what} of {picture.name}; {remedy}")


def read_picture_table(folder: Path, about: AboutPictures, *, compass: bool = False) -> PictureTable:
    """Read the table of a folder and find its pictures, in subfolders or not.

    Rows without a picture and pictures without a row are warned of; `compass` allows azimuths from north. Raises if the
    table is missing, damaged or lacks a column that `about` does not replace, names a file twice, none that exists or
    one outside the folder, has several classes of which none is chosen, or holds an invalid cell.
    """
    inside, named = files_in(folder, "the pictures"), about.get("columns") or {}
    path, names = about.get("table"), about.get("names")
    if names is None:
        path = _only_table(folder, inside) if path is None else Path(path)
        table = read_table(path, "a table with a row for each picture")
    else:
        tables = [Path(path)] if path is not None else [one for one in inside if one.suffix.lower() == ".csv"]
        table = _table_of_names(folder, inside, tables, names)
    columns = chosen_columns(table, named)
    spacing = about.get("spacing_m") is None and first_georeference(sorted(folder.rglob("*"))) is None
    columns = {
        key: name for key, name in columns.items() if key not in FACTORS or any(row[1][name] for row in table.rows)
    }
    if (factor := unused_factor(table, columns)) is not None:
        warn_caller(
            f"{table.path} has the column {shown(factor)}, not used; if it holds factors and not dB, name it with "
            f"`columns={{'scale': '{factor}'}}`, or `columns={{'calibration-factor': '{factor}'}}` for the power's"
        )
    require(table, columns, about.get("grazing_deg") is None, spacing, about.get("look") is not None)
    require_azimuths(table, columns, compass or about.get("azimuth_offset_deg") is not None)
    heading = columns.get("heading")
    if heading is None and not {"azimuth", "az"} & set(named):  # a heading beside azimuths is checked against them
        heading = recognised(table, "heading", columns, needed=False)
    table = converted(table, columns if heading is None else {**columns, "heading": heading})
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
    target = _one_class(table, columns, about.get("target_class"), list(row_of.values()))
    chosen = {at: row for at, row in row_of.items() if target is None or row[1][columns["class"]] == target}
    kept = not compass and not columns.keys() & {"baseline", "polarisation"}
    unplaced = _unplaced(table, columns, chosen, kept)
    pictures = (
        _listed(table, row, columns, heading, at, at in unplaced)
        for at, row in chosen.items()
        if kept or at not in unplaced
    )
    return PictureTable(table.path, columns, target, tuple(pictures))


def _unplaced(table: CsvTable, columns: Columns, rows: dict[Path, Row], kept: bool) -> set[Path]:
    """Return the pictures whose azimuth is empty, with a warning; none if all are."""
    column = columns.get("azimuth", "")
    unplaced = [at for at, row in rows.items() if column and "heading" not in columns and not row[1][column]]
    if not 0 < len(unplaced) < len(rows):
        return set()
    warn_caller(
        f"{table.path} has no azimuth ({column}) for {counted(len(unplaced), 'picture')} of {len(rows)} (the first in "
        f"line {rows[unplaced[0]][0]}), {'kept for `sarsplat locate`' if kept else 'left out'}; fill in what you need"
    )
    return set(unplaced)


def _one_class(table: CsvTable, columns: Columns, chosen: str | None, rows: list[Row]) -> str | None:
    """Return the class whose pictures are taken: a dataset shows one target."""
    if "class" not in columns:
        if chosen is not None:
            raise SarsplatError(
                f"{table.path} has no column of classes to choose {shown(chosen)} from; name it with "
                "`columns={'class': 'NAME'}`, or leave out `target_class`"
            )
        return None
    classes = list(dict.fromkeys(row[1][columns["class"]] for row in rows))
    if chosen in classes:
        return chosen
    if chosen is not None or len(classes) > 1:
        names = ", ".join(name if name and name.isprintable() else shown(name) for name in classes[:20])
        raise SarsplatError(
            f"{table.path} has pictures of {len(classes)} classes ({names}); choose one as `target_class`"
        )
    return classes[0] or None


def _only_table(folder: Path, files: list[Path]) -> Path:
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    products = {kind for path in files for start, kind in _PRODUCTS.items() if path.name.lower().startswith(start)}
    if products and not tables:
        raise SarsplatError(
            f"{folder} holds a product in {products.pop()}, whose geometry is not read; of complex images make SICD, "
            "as by sarpy, for `sarsplat import sicd`, of GRD GeoTIFFs corrected for terrain, to be given with "
            "a table of angles, `geocoded='terrain'` and that `terrain`"
        )
    if len(tables) != 1:
        number = f"{len(tables)} tables (CSV)" if tables else "no table (CSV) of its pictures"
        raise SarsplatError(f"{folder} has {number}; give the right one as `table`")
    return tables[0]


def _table_of_names(folder: Path, files: list[Path], tables: list[Path], pattern: str) -> CsvTable:
    """Make the table of the columns in the pictures' names."""
    *parts, end = _COLUMN.split(pattern)  # texts before columns, and these
    if not parts or len(set(columns := parts[1::2])) < len(columns) or "file" in columns:
        raise SarsplatError(
            f"`names` is {shown(pattern)}; give a name with columns in braces, each once, such as "
            "{azimuth}_{grazing}.png"
        )
    if tables:
        raise SarsplatError(f"`names` replaces the table {tables[0]}; leave `names` out, or move the table elsewhere")
    texts = zip(map(re.escape, parts[::2]), columns, strict=True)
    wanted = re.compile("".join(f"{text}([^/]+?)" for text, _ in texts) + re.escape(end))
    rows: list[Row] = []
    for path in sorted(path for path in files if path.suffix.lower() in PICTURE_ENDINGS):
        inside = path.relative_to(folder).as_posix()
        if found := wanted.fullmatch(inside if "/" in pattern else path.name):
            rows.append((len(rows) + 1, {"file": inside, **dict(zip(columns, found.groups(), strict=True))}))
    if not rows:
        raise SarsplatError(f"{folder} has no picture called like {shown(pattern)}; give a pattern that they match")
    return CsvTable(Path(pattern), ("file", *columns), tuple(rows))


def _listed(
    table: CsvTable, row: Row, columns: Columns, heading: str | None, path: Path, unplaced: bool
) -> ListedPicture:
    def text(meaning: str) -> str:
        return row[1][columns[meaning]] if meaning in columns else ""

    def number(meaning: str) -> float | None:
        return table.number(row, columns[meaning]) if text(meaning) else None

    def pair(meaning: str) -> tuple[float | None, float | None]:
        both = number(meaning)
        azimuth, slant = number(f"azimuth-{meaning}"), number(f"range-{meaning}")
        return (both if azimuth is None else azimuth), (both if slant is None else slant)

    _require_right_angle(table, row, columns)
    grazing, incidence = number("grazing"), number("incidence")
    return ListedPicture(
        name=text("file"),
        path=path,
        azimuth_deg=table.direction(row, columns["azimuth"]) if "azimuth" in columns and not unplaced else None,
        heading_deg=_heading_deg(table, row, columns, heading),
        grazing_deg=90 - incidence if grazing is None and incidence is not None else grazing,
        spacing_m=pair("spacing"),
        resolution_m=pair("resolution"),
        azimuth_std_deg=math.inf if unplaced else number("azimuth-std"),
        split=_split(table, row, columns["split"]) if text("split") else None,
        looks_left=LOOKS[one_of(table, row, columns["look"], LOOKS)] if text("look") else None,
        tilt_deg=number("tilt"),
        scale=number("scale"),
        power_factor=_power_factor(table, row, columns),
        offset=number("offset"),
        near=cast(Side, one_of(table, row, columns["near-side"], SIDES)) if text("near-side") else None,
        view=text("view") or None,
        baseline_rad=number("baseline"),
        polarisation=text("polarisation").upper() or None,
    )


def _heading_deg(table: CsvTable, row: Row, columns: Columns, heading: str | None) -> float | None:
    if heading is None or ("azimuth" in columns and not math.isfinite(parsed(row[1][heading], table.decimal_comma))):
        return None
    return table.direction(row, heading)


def _require_right_angle(table: CsvTable, row: Row, columns: Columns) -> None:
    """Raise if grazing and incidence angle of a row do not add to 90°, as depressions at the radar do not."""
    names = [columns[one] for one in ("grazing", "incidence") if one in columns and row[1][columns[one]]]
    if len(names) < 2:
        return
    grazing, incidence = (table.number(row, name) for name in names)
    if abs(grazing + incidence - 90) > _ROUNDED_DEG:
        raise SarsplatError(
            f"{table.path}, line {row[0]}: {names[0]} is {grazing:g}° and {names[1]} is {incidence:g}°, which do not "
            f"add to 90°; say which of them holds at the target with `columns={{'grazing': '{names[0]}'}}` or "
            f"`columns={{'incidence': '{names[1]}'}}`"
        )


def _power_factor(table: CsvTable, row: Row, columns: Columns) -> float | None:
    """Return the factor on a row's power; None if no row states one, or a column of scales is named."""
    stated = [(columns[one], power) for one, (power, _) in FACTORS.items() if one in columns and "scale" not in columns]
    if len(stated) > 1:
        raise SarsplatError(
            f"{table.path} states two factors of its pictures, {stated[0][0]} and {stated[1][0]}; remove or rename one"
        )
    return math.prod(positive(table, row, column) ** power for column, power in stated) if stated else None


def _split(table: CsvTable, row: Row, column: str) -> str:
    name = row[1][column].lower()
    if name.startswith("test"):
        return name
    one_of(table, row, column, ("train", "training", "test…"))
    return "train"


def positive(table: CsvTable, row: Row, column: str) -> float:
    """Parse a cell as a positive number of plausible size."""
    least, most = _SCALES
    if not least <= (value := table.number(row, column)) <= most:
        raise SarsplatError(
            f"{table.path}, line {row[0]}: {column} is {value:g}; it must be a number from {least:g} to {most:g}"
        )
    return value


def one_of(table: CsvTable, row: Row, column: str, choices: Collection[str]) -> str:
    """Parse a cell as one of some words, in small letters."""
    word = row[1][column].lower()
    if word not in choices:
        raise SarsplatError(
            f"{table.path}, line {row[0]}: {column} is {shown(row[1][column])}; it must be one of {', '.join(choices)}"
        )
    return word
