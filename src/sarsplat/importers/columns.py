"""Meanings of the columns in a table of pictures, named by the user or recognised by their usual names."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

from sarsplat.data.csv_table import CsvTable, Row, parsed
from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.names import Quantity

MEANINGS: dict[str, tuple[str, ...]] = {
    "file": ("filename", "path", "image", "imagefile", "imagepath", "chip", "picture"),
    "azimuth": ("az", "azim", "aspect"),
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
    "scale-factor": (),
    "calibration-factor": (),
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
FACTORS: dict[str, tuple[int, tuple[Quantity, ...]]] = {
    "dn-per-magnitude": (-2, ("amplitude", "complex")),
    "dn-per-power": (-1, ("power",)),
    "scale-factor": (2, ("amplitude", "complex")),
    "calibration-factor": (1, ("amplitude", "complex", "power")),
}
"""Meaning → exponent that makes its number a factor on the power, and possible quantities of the pixels."""

_LENGTH, _ANGLE, _FACTOR = "length", "angle", "a linear factor"
_USUAL = {_LENGTH: "metres", _ANGLE: "degrees", _FACTOR: "factors (x dB: 10^(x/20) on amplitudes, 10^(x/10) on power)"}
"""Units of numbers that are not converted."""
_RADIAN = math.degrees(1.0)
_UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), (_LENGTH, 1.0)),
    **{word: (_LENGTH, size) for word, size in {"km": 1e3, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "µm": 1e-6}.items()},
    **dict.fromkeys(("inch", "inches", "in"), (_LENGTH, 0.0254)),
    **dict.fromkeys(("ft", "foot", "feet"), (_LENGTH, 0.3048)),
    **dict.fromkeys(("deg", "degree", "degrees"), (_ANGLE, 1.0)),
    **dict.fromkeys(("rad", "radian", "radians"), (_ANGLE, _RADIAN)),
    **{**dict.fromkeys(("gon", "gradian", "gradians"), (_ANGLE, 0.9)), "mrad": (_ANGLE, _RADIAN / 1e3)},
    **dict.fromkeys(("mil", "mils", "yd", "arcmin", "arcsec", "grad"), ("another unit", 1.0)),
}
"""Words in names of columns → quantity, and m or degrees of one (a grad may be a German degree)."""
_FOREIGN = {word: ("foreign", 1.0) for word in ("hz", "khz", "mhz", "ghz", "db", "decibel", "decibels")}
"""Words for units that are not converted; numbers per unit are something else."""
_MEASURED = {
    **dict.fromkeys(("azimuth", "heading", "grazing", "incidence", "azimuth-std", "tilt"), (_ANGLE, 1.0)),
    "baseline": (_ANGLE, _RADIAN),
    **dict.fromkeys(("scale", *FACTORS), (_FACTOR, 1.0)),
    **{f"{axis}{name}": (_LENGTH, 1.0) for axis in ("", "azimuth-", "range-") for name in ("spacing", "resolution")},
}
"""Meanings with a unit → quantity, and m or degrees of the unit that numbers have here."""
_FLIGHT = {"heading", "track", "course"}  # words in columns' names for directions of flight
_COMPASS = {"compass", "north"}  # words in columns' names for directions counted from north
_ONLY_IF_NAMED = ("scale", "offset")  # meanings without usual names: too many things are called that
_INSTEAD = {"azimuth": "heading", "heading": "azimuth"}  # meanings that exclude each other if one is chosen

_FACTOR_WORDS = {"scale", "gain", "factor", "calfactor", "calibration", "cal"}
"""Words in columns' names for factors of pictures."""

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
    decided = {*_ONLY_IF_NAMED, *(elevations if elevations & chosen.keys() else ())}
    for meaning in MEANINGS:
        if meaning not in chosen.keys() | decided and _INSTEAD.get(meaning) not in chosen:
            usual = recognised(table, meaning, chosen)
            if usual is not None:
                chosen[meaning] = usual
    return chosen


def told_of_factor(meaning: str, name: str) -> str:
    """Return a sentence on the use of a factor with a meaning of `FACTORS` and this name."""
    exponent, _ = FACTORS[meaning]
    return f"power is {'multiplied' if exponent > 0 else 'divided'} by {'the square of ' * (abs(exponent) == 2)}{name}"


def unused_factor(table: CsvTable, columns: Columns) -> str | None:
    """Return a column that is called a factor and has no meaning; None without one."""
    unused = [name for name in table.columns if name not in columns.values() and _FACTOR_WORDS & set(_words(name))]
    return next((name for name in unused if any(cells[name] for _, cells in table.rows)), None)


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


def recognised(table: CsvTable, meaning: str, chosen: Columns, *, needed: bool = True) -> str | None:
    """Return the only column with a usual name, or None; several raise if it is `needed`, and are None otherwise."""
    usual = (meaning.replace("-", ""), *MEANINGS[meaning])
    candidates = [name for name in table.columns if _plain(name) in usual and name not in chosen.values()]
    if len(candidates) > 1 and (exact := [name for name in candidates if _plain(name) == usual[0]]):
        candidates = exact
    if len(candidates) > 1 and needed:
        raise SarsplatError(
            f"{table.path} has several columns that may be the {meaning}: {', '.join(map(shown, candidates))}; "
            f"say which with `columns={{'{meaning}': 'NAME'}}`"
        )
    return candidates[0] if len(candidates) == 1 else None


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
        present = [*filter(None, table.columns)]
        listed = ", ".join(present[:20])[:400] + (", …" if len(present) > 20 else "")
        incidence = " (incidence, not grazing, for a column of incidence angles)" * ("grazing" in lacking)
        raise SarsplatError(
            f"{table.path} has no column that looks like the {' or the '.join(lacking)}; name "
            f"{'it' if len(lacking) == 1 else 'them'} with `columns={{{named}}}`{incidence}"
            f"{''.join(f', or give {one}' for one in also)} (there are {listed})"
        )


def require_azimuths(table: CsvTable, columns: Columns, compass: bool) -> None:
    """Raise if the azimuths' column is one of flights by its name or, unless `compass`, counts from north."""
    column = columns.get("azimuth", "")
    words = set(_words(column))
    if words & _FLIGHT:
        raise SarsplatError(
            f"{table.path} has {shown(column)} for the azimuth, by its name a direction of flight; name it with "
            f"`columns={{'heading': '{column}'}}` and give `look`, or rename it if it is not"
        )
    if "bearing" in words and not compass:
        raise SarsplatError(
            f"{table.path} has {shown(column)} for the azimuth, a direction of sight by its name; if it is from the "
            "radar to the target, add 180°, and rename it"
        )
    if words & _COMPASS and not compass:
        raise SarsplatError(
            f"{table.path} has {shown(column)} for the azimuth, which counts from north by its name, but azimuths "
            "count from the target's nose; give `azimuth_offset_deg`, the azimuth of north (0 if the nose points there)"
        )


def converted(table: CsvTable, columns: Columns) -> CsvTable:
    """Return a table whose lengths are in m, angles in degrees and baselines in radians, by the names of its columns.

    Raises if a name has a unit of another quantity, or several units.
    """
    factors: dict[str, float] = {}
    for meaning, (kind, usual) in _MEASURED.items():
        words = _words(column := columns.get(meaning, ""))
        foreign = {} if "per" in words else _FOREIGN
        units = foreign if kind == _FACTOR else _UNITS | foreign
        stated = {units[word] for word in words if word in units and (word != "in" or word == words[-1])}
        if len(stated) > 1 or any(quantity != kind for quantity, _ in stated):
            unit = "b/R in radians" if meaning == "baseline" else _USUAL[kind]
            raise SarsplatError(
                f"{table.path} has {shown(column)} for the {meaning}, whose name does not state one unit of {kind}; "
                f"give {unit}, and rename it"
            )
        for _, size in stated - {(kind, usual)}:
            factors[column] = size / usual

    def number(text: str, factor: float) -> str:
        value = parsed(text, table.decimal_comma)
        return f"{value * factor!r}" if math.isfinite(value) else text

    rows = ((at, cells | {name: number(cells[name], by) for name, by in factors.items()}) for at, cells in table.rows)
    return replace(table, rows=tuple(rows))


def _words(name: str) -> list[str]:
    return re.findall(
        r"[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.replace("º", " deg ").replace("dB", " db ")).lower()
    )


def _plain(name: str) -> str:
    """Strip case, signs and units: `Azimuth (deg)` and `azimuth_angle_deg` become `azimuth`."""
    words = _words(name)
    while len(words) > 1 and (words[-1] in _UNITS or words[-1] == "angle"):
        words.pop()
    return "".join(words)


def _require_known(problem: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        raise SarsplatError(f"{problem} {shown(name)}; {advised(name, [*filter(None, names)][:40])}")
