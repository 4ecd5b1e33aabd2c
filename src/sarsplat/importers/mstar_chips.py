"""Find and read MSTAR chips: JPEGs described by a table of labels, or Phoenix files, which describe themselves."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
from jaxtyping import Float32

from sarsplat.data.csv_table import CsvTable, Row, read_table
from sarsplat.data.orientation import SIDES
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry.responses import TAYLOR, Response
from sarsplat.importers.columns import refuse_two_radars, unusual_look
from sarsplat.importers.files import files_in, listed_files, warn_caller
from sarsplat.importers.phoenix import is_phoenix, read_phoenix
from sarsplat.importers.pictures import read_pixels
from sarsplat.importers.table import one_of, positive
from sarsplat.names import Side

_DESIRED, _MEASURED, _AZIMUTH = "desired_depression_deg", "measured_depression_deg", "target_az_deg"
LABEL_COLUMNS = ("path", "class", "serial", _DESIRED, _MEASURED, _AZIMUTH)
"""Columns that a table of labels must have."""
_AZIMUTH_STD = "azimuth_std_deg"  # optional column, cells may be empty
_DN_PER_MAGNITUDE = "dn_per_magnitude"  # optional column, filled for all chips or none
_DN_PER_POWER = "dn_per_power"  # column of generated chips that hold power, not magnitude
_NEAR_SIDE = "near_side"  # optional column; the bottom if empty
_LENGTHS = {
    "spacing_m": ("azimuth_spacing_m", "range_spacing_m"),
    "resolution_m": ("azimuth_resolution_m", "range_resolution_m"),
}
"""Optional columns; MSTAR's lengths if empty."""

_DESCRIBING = (
    *LABEL_COLUMNS[1:],
    *(_AZIMUTH_STD, _DN_PER_MAGNITUDE, _NEAR_SIDE),
    *(column for pair in _LENGTHS.values() for column in pair),
)
"""Columns that describe a chip."""


@dataclass(frozen=True)
class Chip:
    """One measured chip, in the order of its file's array."""

    name: str
    """Path relative to the folder of chips."""
    serial: str
    """Serial number of the vehicle."""
    depression: int
    """Planned depression angle, whole degrees: the name of the collection."""
    grazing_deg: float
    """Measured depression angle."""
    target_az_deg: float
    """TargetAz, in [0, 360): 0 = nose toward the radar; NaN if unknown."""
    read: Callable[[], Float32[np.ndarray, "rows columns"]]
    """Function that reads `magnitude`."""
    step: float
    """Magnitude of one digital number; 0 if magnitudes are not quantised."""
    spacing_m: tuple[float, float] = (0.203125, 0.202148)
    """(cross-range, slant range)."""
    resolution_m: tuple[float, float] = (0.3229, 0.3013)
    """3 dB widths, as `spacing_m`."""
    response: Response = TAYLOR
    """Response of the system; for JPEGs that of the Phoenix files' headers."""
    near: Side = "bottom"
    """Side of the array that is near the radar."""
    azimuth_std_deg: float | None = None
    """Standard deviation of the azimuth; None if not stated."""
    phase: Float32[np.ndarray, "rows columns"] | None = None
    """Radians; None if unknown."""

    @cached_property
    def magnitude(self) -> Float32[np.ndarray, "rows columns"]:
        """Linear magnitude (not power), in the common unit of all chips; raises if the file is damaged."""
        return self.read()

    @property
    def placed(self) -> bool:
        """True if its azimuth is known."""
        return math.isfinite(self.target_az_deg)


def read_chips(
    folder: Path, labels: Path | None, target_class: str | tuple[str, ...], *, unplaced: bool = False
) -> list[Chip]:
    """Find all chips of one class, by any of its names, in a folder and its subfolders, in the order of table or files.

    `labels` is a table (CSV) of JPEGs, whose pixels are not read yet: path relative to `folder`, class, serial,
    desired_depression_deg, measured_depression_deg (the desired one if empty), target_az_deg; optionally
    azimuth_std_deg, dn_per_magnitude (digital numbers per unit of magnitude, in a unit common to all chips), near_side,
    and lengths as in `_LENGTHS`. None: read Phoenix files, whose headers state all that. `T72` and a Phoenix header's
    `t72_tank` are the same class. Chips without azimuth are included only if `unplaced`.

    Raises if the folder is missing or empty, the labels are garbled, contradict each other, lead out of the folder or
    match no chip, the class is unknown, or a Phoenix file is damaged. Other gaps in the table are warned of.
    """
    target_class = (target_class,) if isinstance(target_class, str) else target_class
    files = files_in(folder, "the MSTAR chips")
    jpegs = {path for path in files if path.suffix.lower() in (".jpeg", ".jpg")}
    if labels is None:
        return _phoenix_chips(folder, files, bool(jpegs), target_class)
    return _jpeg_chips(folder, jpegs, labels, target_class, unplaced)


def classes_in(folder: Path, labels: Path | None) -> list[str]:
    """Return the classes that `read_chips` finds, as named by the table or by headers."""
    if labels is not None:
        names = {row["class"] for _, row in read_labels(labels).rows} - {""}
    else:
        names = {read_phoenix(path).target_type for path in files_in(folder, "the MSTAR chips") if is_phoenix(path)}
    if not names:
        raise SarsplatError(f"{labels or folder} names no class; give the folder or the table of the MSTAR chips")
    return sorted(names)


def plain_name(name: str) -> str:
    """Return a name in small letters and digits alone: `ZSU_23-4` becomes `zsu234`."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def same_class(names: str | tuple[str, ...], given: str) -> bool:
    """Return whether one of some names and another mean one class: `T-72` = `t72` = `t72_tank`."""
    plain = {plain_name(name) for name in ((names,) if isinstance(names, str) else names)}
    return not plain.isdisjoint((plain_name(given), plain_name(given.split("_")[0])))


def _refuse_class(target_class: tuple[str, ...], where: Path, classes: set[str]) -> NoReturn:
    names = ", ".join(name if name.isprintable() else shown(name) for name in sorted(classes)[:20])
    raise SarsplatError(f"there is no class {target_class[0]!r} in {where}; it has {names}")


def _phoenix_chips(folder: Path, files: list[Path], has_jpegs: bool, target_class: tuple[str, ...]) -> list[Chip]:
    chosen, classes = [], set()
    for path in files:  # of thousands, only those of the class stay in memory
        if is_phoenix(path):
            chip = read_phoenix(path)
            classes.add(chip.target_type)
            if same_class(target_class, chip.target_type):
                chosen.append(chip)
    if not classes:
        remedy = "give the table of its JPEGs as `labels`" if has_jpegs else "give the folder of the MSTAR chips"
        raise SarsplatError(f"there is no Phoenix file in {folder}; {remedy}")
    if has_jpegs:
        warn_caller(
            f"{folder} also contains JPEG chips, which are ignored; to use them instead of the Phoenix files, "
            "give the table of their `labels`"
        )
    if not chosen:
        _refuse_class(target_class, folder, classes)
    for chip in chosen:
        chip.require_radar_at_the_bottom()
    return [
        Chip(
            name=str(chip.path.relative_to(folder)),
            serial=chip.serial,
            depression=round(chip.desired_depression_deg),
            grazing_deg=chip.measured_depression_deg,
            target_az_deg=chip.target_az_deg % 360,
            read=partial(getattr, chip, "magnitude"),
            step=0.0,
            spacing_m=chip.spacing_m,
            resolution_m=chip.resolution_m,
            response=chip.response,
            phase=chip.phase,
        )
        for chip in chosen
    ]


def _jpeg_chips(
    folder: Path, jpegs: set[Path], labels: Path, target_class: tuple[str, ...], unplaced: bool
) -> list[Chip]:
    table = read_labels(labels)
    refuse_two_radars(table)
    rows = [row for row in table.rows if same_class(target_class, row[1]["class"])]
    if not rows:
        _refuse_class(target_class, labels, {row["class"] for _, row in table.rows})
    present = listed_files(folder, table, rows, "path", of="chip")
    labelled = {folder / row["path"] for _, row in table.rows if row["class"]}
    if unlabelled := len(jpegs - labelled - {path for _, path in present}):
        warn_caller(f"{labels} has no label for {counted(unlabelled, 'JPEG')} in {folder}; add those that you need")
    paths = {row[1]["path"]: path for row, path in present}
    chosen = _once(labels, _complete(labels, [row for row, _ in present], unplaced))
    for row in chosen:
        if column := unusual_look(table, row):
            raise SarsplatError(
                f"{labels}, line {row[0]}: {column} is {shown(row[1][column])}, but MSTAR's radar is one, flies level "
                "and looks to its right; import these chips with `sarsplat import folder`"
            )
    return [
        Chip(
            name=row[1]["path"],
            serial=row[1]["serial"],
            depression=round(table.number(row, _DESIRED)),
            grazing_deg=table.number(row, _MEASURED),
            target_az_deg=table.direction(row, _AZIMUTH) % 360 if row[1][_AZIMUTH] else math.nan,
            read=partial(_magnitude, paths[row[1]["path"]], step),
            step=step,
            near=cast(Side, one_of(table, row, _NEAR_SIDE, SIDES)) if row[1].get(_NEAR_SIDE) else "bottom",
            azimuth_std_deg=table.number(row, _AZIMUTH_STD) if row[1].get(_AZIMUTH_STD) else None,
            **_lengths(table, row),
        )
        for row, step in zip(chosen, _steps(table, chosen), strict=True)
    ]


def _lengths(table: CsvTable, row: Row) -> dict[str, Any]:
    """Return spacing and resolution, as far as a row states them."""
    stated = {name: columns for name, columns in _LENGTHS.items() if all(row[1].get(column) for column in columns)}
    return {name: tuple(table.number(row, column) for column in columns) for name, columns in stated.items()}


def _complete(labels: Path, rows: Sequence[Row], unplaced: bool) -> list[Row]:
    """Leave out rows without angles, with a warning; an empty measured depression becomes the desired one.

    These two differ by tenths of a degree.
    """
    whole = [(line, row) for line, row in rows if row[_DESIRED] and (row[_AZIMUTH] or unplaced)]
    if len(whole) < len(rows):
        line, row = next(item for item in rows if item not in whole)
        missing = _AZIMUTH if row[_DESIRED] else _DESIRED
        what = f"{labels} has empty fields for {len(rows) - len(whole)} of {counted(len(rows), 'chip')}"
        if not whole:
            raise SarsplatError(f"{what} (line {line}: {missing} is empty); fill them in")
        warn_caller(f"{what} (the first: {missing} in line {line}), left out; fill in what you need")
    if planned := [line for line, row in whole if not row[_MEASURED]]:
        warn_caller(
            f"{labels} has no {_MEASURED} for {len(planned)} of {counted(len(whole), 'chip')} (the first in line "
            f"{planned[0]}), so their {_DESIRED} is used; fill them in if you know better"
        )
    return [(line, {**row, _MEASURED: row[_MEASURED] or row[_DESIRED]}) for line, row in whole]


def _once(labels: Path, rows: Sequence[Row]) -> list[Row]:
    """Remove repeated labels: no chip may be trained on and tested on."""
    first: dict[Path, Row] = {}
    for line, row in rows:
        other_line, other = first.setdefault(Path(row["path"]), (line, row))
        if any(row.get(name) != other.get(name) for name in _DESCRIBING):
            raise SarsplatError(
                f"{labels} gives {shown(row['path'])} two labels, in lines {other_line} and {line}; remove one"
            )
    if repeated := len(rows) - len(first):
        warn_caller(f"{labels} repeats {counted(repeated, 'label')}; each chip is taken once")
    return list(first.values())


def read_labels(path: Path) -> CsvTable:
    """Read the table of labels; raise if it cannot be read, or a column is missing."""
    return read_table(path, "the table of labels", LABEL_COLUMNS)


def _steps(table: CsvTable, rows: Sequence[Row]) -> list[float]:
    """Return the magnitude of one digital number of each chip; 1 if the table scales none."""
    if _DN_PER_POWER in table.columns:
        raise SarsplatError(
            f"{table.path} has a column {_DN_PER_POWER}, so its chips hold power, but MSTAR's hold magnitude; import "
            "them with `sarsplat import folder`"
        )
    if not any(row.get(_DN_PER_MAGNITUDE) for _, row in rows):
        return [1.0] * len(rows)
    return [1 / positive(table, row, _DN_PER_MAGNITUDE) for row in rows]


def _magnitude(path: Path, step: float) -> Float32[np.ndarray, "rows columns"]:
    """Read an 8-bit grey picture as magnitude, `step` for each digital number."""
    pixels = read_pixels(path)
    if pixels.dtype != np.uint8 or pixels.ndim != 2:
        raise SarsplatError(
            f"{path} holds {pixels.dtype} of shape {shown(pixels.shape)}, but chips are 8-bit grey; import others with "
            "`sarsplat import folder`"
        )
    return pixels.astype(np.float32) * np.float32(step)
