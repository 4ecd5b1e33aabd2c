"""Meanings of the columns in a table of pictures, named by the user or recognised by their usual names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from sarsplat.data.csv_table import CsvTable, Row, parsed
from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.names import Quantity

MEANINGS: dict[str, tuple[str, ...]] = {
    "file": ("filename", "path", "image", "imagefile", "imagepath", "chip", "picture"),
    "azimuth": ("az", "azim", "aspect", "bearing"),
    "heading": ("platformheading", "flightheading", "flightdirection", "track", "course"),
    "grazing": ("graz", "elevation", "elev", "el", "depression", "measureddepression"),
    "incidence": ("inc", "incident"),
    "spacing": ("pixelspacing", "pixel"),
    "azimuth-spacing": ("spacingazimuth", "azimuthpixelspacing", "crossrangespacing", "crossrangepixelspacing"),
    "range-spacing": ("spacingrange", "rangepixelspacing"),
    "resolution": ("res",),
    "azimuth-resolution": ("resolutionazimuth", "crossrangeresolution"),
    "range-resolution": ("resolutionrange",),
    "split": ("set", "subset"),
    "azimuth-std": ("azstd", "azimuthuncertainty"),
    "class": (),
    "look": ("lookside", "lookdirection", "side", "radarside"),
    "tilt": (),
    "scale": (),
    "offset": (),
    "dn-per-magnitude": (),
    "dn-per-power": (),
    "near-side": (),
    "view": ("viewname", "stack"),
    "baseline": ("baselinerad", "lookoffset"),
    "polarisation": ("polarization", "pol"),
}
"""Meanings of columns → other usual names of such columns, without units."""

_SHORT = {
    **{"az": "azimuth", "graz": "grazing", "elev": "grazing", "inc": "incidence", "std": "azimuth-std"},
    **{"pol": "polarisation", "polarization": "polarisation"},
}
_UNITS = {"deg", "degree", "degrees", "m", "metre", "metres", "meter", "meters", "angle"}

_ANGLES = ("azimuth", "heading", "grazing", "incidence", "azimuth-std", "tilt")
_OTHER_ANGLES = {"rad", "radian", "radians", "mrad", "gon", "gradian", "gradians", "mil", "mils"}
"""Words in columns' names for units of angles other than degrees (the German Grad is a degree)."""
_COMPASS = {"compass", "bearing", "north"}
"""Words in columns' names for directions counted from north."""

_ONLY_IF_NAMED = ("scale", "offset")
"""Meanings without usual names: too many things are called that."""

_INSTEAD = {"azimuth": {"heading"}, "heading": {"azimuth"}}
"""Meanings that exclude each other if one is chosen."""

PER_UNIT: dict[str, tuple[Quantity, ...]] = {"dn-per-magnitude": ("amplitude", "complex"), "dn-per-power": ("power",)}
"""Meaning (numbers per unit of magnitude, or of power) → possible quantities of the pixels."""

Columns = dict[str, str]
"""Meaning → name of the column."""

LOOKS = {"left": True, "l": True, "right": False, "r": False}
"""Cells of a column look → True if the radar looks left."""


def chosen_columns(table: CsvTable, named: Mapping[str, str]) -> Columns:
    """Choose columns: those `named` (meaning, az, graz, inc or std → column), and others by their usual names.

    Raises if there is no such meaning or column, or two columns may have the same meaning.
    """
    refuse_two_radars(table)
    chosen: Columns = {}
    for key, column in named.items():
        meaning = _SHORT.get(key, key)
        _require_known("no column can be a", meaning, MEANINGS)
        _require_known(f"{table.path} has no column", column, table.columns)
        chosen[meaning] = column
    elevations = {"grazing", "incidence"}
    named_elevation = elevations & set(chosen)
    if elevations <= set(chosen):
        raise SarsplatError("`columns` names both a grazing and an incidence angle; name one of them")
    for meaning in MEANINGS:
        others = elevations if meaning in elevations else _INSTEAD.get(meaning, set())
        otherwise_named = bool(others & set(chosen)) and (meaning not in elevations or named_elevation)
        if meaning not in (*chosen, *_ONLY_IF_NAMED) and not otherwise_named:
            usual = recognised(table, meaning, chosen)
            if usual is not None:
                chosen[meaning] = usual
    return chosen


def refuse_two_radars(table: CsvTable) -> None:
    """Raise if a table has angles of a transmitter or a receiver: bistatic images are not supported."""
    for column in table.columns:
        if re.fullmatch(r"(transmit(ter)?|tx|receiver?|rx)(az|graz|inc|el).*", _plain(column)):
            raise SarsplatError(
                f"{table.path} has the column {shown(column)} of bistatic images, which are not supported; give images "
                "of one radar, in a table without it"
            )


def unusual_look(table: CsvTable, row: Row) -> str | None:
    """Return the column by which a row's radar is tilted or looks left; None without one."""
    for column in table.columns:
        cell, name = row[1][column].lower(), _plain(column)
        meanings = [one for one in ("look", "tilt") if name in (one.replace("-", ""), *MEANINGS[one])]
        usual = {"look": LOOKS.get(cell) is False, "tilt": parsed(cell, table.decimal_comma) == 0}
        if cell and meanings and not usual.get(meanings[0]):
            return column
    return None


def recognised(table: CsvTable, meaning: str, chosen: Columns) -> str | None:
    """Return the only column with a usual name, or None."""
    usual = (meaning.replace("-", ""), *MEANINGS[meaning])
    candidates = [name for name in table.columns if _plain(name) in usual and name not in chosen.values()]
    if len(candidates) > 1 and (exact := [name for name in candidates if _plain(name) == usual[0]]):
        candidates = exact
    if len(candidates) > 1:
        raise SarsplatError(
            f"{table.path} has several columns that may be the {meaning}: {', '.join(map(shown, candidates))}; "
            f"say which with `columns={{'{meaning}': 'NAME'}}`"
        )
    return candidates[0] if candidates else None


def require(table: CsvTable, columns: Columns, grazing: bool, spacing: bool, looking: bool = False) -> None:
    """Raise if a table lacks columns, naming all; those of `grazing` angles and `spacing` only if these are needed.

    Headings serve as azimuths if the side to which the radar looks is known: `looking`, or by a column.
    """
    lacking = [meaning for meaning in ("file", "azimuth") if meaning not in columns]
    also = []
    if "heading" in columns and "azimuth" in lacking:
        if looking or "look" in columns:
            lacking.remove("azimuth")
        else:
            also.append(f"`look`, the side to which the radar looks, if {shown(columns['heading'])} is its flight's")
    if grazing and not columns.keys() & {"grazing", "incidence"}:
        lacking.append("grazing")
        also.append("`grazing_deg`, one grazing angle for all")
    if spacing and not columns.keys() & {"spacing", "azimuth-spacing", "range-spacing"}:
        lacking.append("spacing")
        also.append("`spacing_m`, one spacing for all")
    if lacking:
        named = ", ".join(f"'{meaning}': 'NAME'" for meaning in lacking)
        incidence = " (incidence, not grazing, for a column of incidence angles)" * ("grazing" in lacking)
        raise SarsplatError(
            f"{table.path} has no column that looks like the {' or the '.join(lacking)}; name "
            f"{'it' if len(lacking) == 1 else 'them'} with `columns={{{named}}}`{incidence}"
            f"{''.join(f', or give {one}' for one in also)} (there are {_has(table)})"
        )


def require_degrees(table: CsvTable, columns: Columns, compass: bool) -> None:
    """Raise if a column's name has another unit than degrees or, unless `compass`, counts azimuths from north."""
    for meaning in _ANGLES:
        words = set(_words(columns.get(meaning, "")))
        if words & _OTHER_ANGLES:
            raise SarsplatError(
                f"{table.path} has {shown(columns[meaning])} for the {meaning}, which is not in degrees by its name; "
                "write degrees"
            )
        if words & _COMPASS and meaning == "azimuth" and not compass:
            raise SarsplatError(
                f"{table.path} has {shown(columns[meaning])} for the {meaning}, which counts from north by its name, "
                "but azimuths count from the target's nose; give `azimuth_offset_deg`, the azimuth of north (0 if the "
                "nose points there)"
            )


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())


def _plain(name: str) -> str:
    """Strip case, signs and units: `Azimuth (deg)` and `azimuth_angle_deg` become `azimuth`."""
    words = _words(name)
    while len(words) > 1 and words[-1] in _UNITS:
        words.pop()
    return "".join(words)


def _require_known(problem: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        printable = [one for one in names if one and one.isprintable()]
        raise SarsplatError(f"{problem} {shown(name)}; {advised(name, printable[:40])}")


def _has(table: CsvTable) -> str:
    named = [name if name.isprintable() else shown(name) for name in table.columns if name]
    return ", ".join(named[:20])[:400] + (", …" if len(named) > 20 else "")
