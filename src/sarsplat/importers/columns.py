"""Meaning of the columns of a table of images: as the user names them, or recognised by their usual names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

from sarsplat.data.csv_table import CsvTable
from sarsplat.errors import SarsplatError, shown

MEANINGS: dict[str, tuple[str, ...]] = {
    "file": ("filename", "path", "image", "imagefile", "imagepath", "chip", "picture"),
    "azimuth": ("az", "azim", "aspect", "bearing"),
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
    "look": ("lookside", "lookdirection"),
    "scale": (),
    "offset": (),
    "view": ("viewname", "stack"),
    "baseline": ("baselinerad", "lookoffset"),
    "polarisation": ("polarization", "pol"),
}
"""What a column can say, and other usual names of such columns, without units."""

_SHORT = {
    **{"az": "azimuth", "graz": "grazing", "elev": "grazing", "inc": "incidence", "std": "azimuth-std"},
    **{"pol": "polarisation", "polarization": "polarisation"},
}
_UNITS = {"deg", "degree", "degrees", "m", "metre", "metres", "meter", "meters", "angle"}
_ONLY_IF_NAMED = ("scale", "offset")
"""Too many things are called that."""

Columns = dict[str, str]
"""Meaning → name of the column."""


def chosen_columns(table: CsvTable, named: Mapping[str, str]) -> Columns:
    """The columns that matter: those `named` (meaning, az, graz, inc or std → column), and others by their usual names.

    Raises
    ------
    SarsplatError
        If there is no such meaning or column, or two columns may have the same meaning.
    """
    chosen: Columns = {}
    for key, column in named.items():
        meaning = _SHORT.get(key, key)
        if meaning not in MEANINGS:
            raise SarsplatError(f"no column can be a {shown(key)}{_guess(key, MEANINGS)}; choose {', '.join(MEANINGS)}")
        if column not in table.columns:
            raise SarsplatError(
                f"{table.path} has no column {shown(column)}{_guess(column, table.columns)}; it has {_listed(table)}"
            )
        chosen[meaning] = column
    elevations = {"grazing", "incidence"}
    if elevations <= set(chosen):
        raise SarsplatError("--columns names both a grazing and an incidence angle; name one of them")
    for meaning in MEANINGS:
        otherwise_named = meaning in elevations and elevations & set(chosen)
        if meaning not in (*chosen, *_ONLY_IF_NAMED) and not otherwise_named:
            usual = _recognised(table, meaning, chosen)
            if usual is not None:
                chosen[meaning] = usual
    return chosen


def _recognised(table: CsvTable, meaning: str, chosen: Columns) -> str | None:
    """The one column that has a usual name."""
    usual = (meaning.replace("-", ""), *MEANINGS[meaning])
    candidates = [name for name in table.columns if _plain(name) in usual and name not in chosen.values()]
    if len(candidates) > 1 and (exact := [name for name in candidates if _plain(name) == usual[0]]):
        candidates = exact
    if len(candidates) > 1:
        raise SarsplatError(
            f"{table.path} has several columns that may be the {meaning}: {', '.join(map(shown, candidates))}; "
            f"say which with --columns {meaning}=NAME"
        )
    return candidates[0] if candidates else None


def require(table: CsvTable, columns: Columns, grazing: bool, spacing: bool) -> None:
    """Refuse a table that lacks columns, and name all of them; `grazing`, `spacing`: whether its cells are needed."""
    lacking = [meaning for meaning in ("file", "azimuth") if meaning not in columns]
    also = []
    if grazing and not columns.keys() & {"grazing", "incidence"}:
        lacking.append("grazing")
        also.append("one grazing angle for all with --grazing")
    if spacing and not columns.keys() & {"spacing", "azimuth-spacing", "range-spacing"}:
        lacking.append("spacing")
        also.append("one spacing for all with --spacing")
    if lacking:
        named = ",".join(f"{meaning}=NAME" for meaning in lacking)
        if "grazing" in lacking:
            named += " (incidence=NAME, not grazing, for a column of incidence angles)"
        raise SarsplatError(
            f"{table.path} has no column that looks like the {' or the '.join(lacking)}; name "
            f"{'it' if len(lacking) == 1 else 'them'} with --columns {named}"
            f"{''.join(f', or give {one}' for one in also)} (there are {_listed(table)})"
        )


def _plain(name: str) -> str:
    """`Azimuth (deg)` and `azimuth_angle_deg` are `azimuth`."""
    words = re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())
    while len(words) > 1 and words[-1] in _UNITS:
        words.pop()
    return "".join(words)


def _guess(word: str, names: Mapping[str, object] | tuple[str, ...]) -> str:
    by_lower = {name.lower(): name for name in names if name}
    close = difflib.get_close_matches(word.lower(), by_lower, n=1)
    return f" (did you mean {shown(by_lower[close[0]])}?)" if close else ""


def _listed(table: CsvTable) -> str:
    named = [name if name.isprintable() else shown(name) for name in table.columns if name]
    return ", ".join(named[:20])[:400] + (", …" if len(named) > 20 else "")
