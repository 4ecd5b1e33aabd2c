"""Export of a run as one file for other programs; each format is a module `format_ENDING.py`, or a plug-in."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, counted
from sarsplat.exports.format import Format, Points, content_of, name_of
from sarsplat.exports.georeference import MapSystem, refuse_elsewhere, remove_place, write_place
from sarsplat.exports.maps import Coordinates, map_of, of_terrain, require_fit
from sarsplat.geometry import View
from sarsplat.geometry.place import DATUM
from sarsplat.names import Colour, Content, Map
from sarsplat.plugins import discover
from sarsplat.runs import Run

__all__ = ["FORMATS", "Content", "Format", "MapSystem", "Points", "Written", "export", "export_terrain", "format_of"]

FORMATS = discover(__name__, "format_", "FORMAT", "sarsplat.exports")
"""Formats by the ending of their files, without the dot; each is imported when first used."""


@dataclass(frozen=True)
class Written:
    """Summary of an exported file, and programs that open it."""

    summary: str
    opened_with: str
    beside: str = ""
    """Sentence about its georeference file; "" without one."""


def format_of(path: Path, content: Content | None = None) -> tuple[Format, Content]:
    """Return the format for a file name, and the content: the given one, or the format's first.

    Raises if the ending is unknown, such files cannot hold the content, or the name is ambiguous.
    """
    ending = path.suffix.lower().removeprefix(".")
    named: Format | None = FORMATS.get(ending)
    if named is None or (content is not None and content not in named.writers):
        fit = [f".{ending}" for ending, other in FORMATS.loaded().items() if content in (None, *other.writers)]
        what = {None: "an export", "mesh": "a mesh"}.get(content, content)
        endings = " or ".join(", ".join(fit).rsplit(", ", 1))
        raise SarsplatError(f"{path} is not a valid name for {what}; choose one that ends in {endings}")
    if content is None and named.named_by_content:
        stem = path.stem.lower()
        content = next((holds for holds in named.writers if re.search(rf"(^|[-_ .]){holds}$", stem)), None)
        if content is None and (meant := next((holds for holds in named.writers if holds in stem), None)):
            raise SarsplatError(
                f"{path} has {meant} in its name, but not at the end, so its content is ambiguous; give it, such as "
                f"with `content={meant!r}`"
            )
    return named, next(iter(named.writers)) if content is None else content


@checks_arguments
def export(
    run: Run,
    path: str | Path,
    content: Content | None = None,
    *,
    colour: Colour | None = None,
    crs: str | None = None,
    pixel_m: float | None = None,
    view: View | None = None,
) -> Written:
    """Write a run to one file, complete or not at all.

    If the run has a georeference (`run.place`), files that can hold them have map coordinates; any other file PATH gets
    a file PATH.place.json with its georeference.

    Parameters
    ----------
    run : Run
        Reconstruction.
    path : str or Path
        File to write; its ending decides the format (`FORMATS`). An existing file is replaced.
    content : "gaussians", "points", "mesh", "dsm", "gamma0" or "layover-shadow", optional
        Content, if a format can hold several; a map whose name is, or ends with, one of them holds that.
    colour : "db" or "height", optional
        Colour of Gaussians in viewers: γ⁰ in decibels (the default) or the height.
    crs : str, optional
        Coordinate system of the map, such as "EPSG:32632": projected, in metres; UTM unless given.
    pixel_m : float, optional
        Size of a map's pixels; a resolution cell unless given.
    view : View, optional
        View with layover and shadow; needed for that map only.

    Raises
    ------
    SarsplatError
        If the ending is unknown, the run or the format lacks the content, a package is missing, a colour is given for
        anything other than Gaussians, a system for a format or a run without map coordinates, a pixel for anything
        other than a map, a view is missing or has no effect, or the file cannot be written.
    """
    path = Path(path)
    format, holds = format_of(path, content)
    if colour is not None and holds != "gaussians":
        raise SarsplatError(f"{path} will hold {holds}, whose colours are not chosen; omit the colour")
    refuse_elsewhere(path, format.coordinates, name_of(run), run.place, crs)
    require_fit(path, holds, pixel_m, view)
    system = None if format.coordinates != "map" or run.place is None else MapSystem.of(run.place, crs)
    data: Any
    if holds in get_args(Map):
        data, summary = map_of(run, holds, Coordinates(system), pixel_m, view)
    else:
        data, summary = content_of(run, holds)
    if isinstance(data, Points) and system is not None:
        data, summary = replace(data, system=system), f"{counted(len(data.positions), 'point')}, {system}"
    elif holds == "mesh":
        summary = f"{summary}, {format.up}"
    elif format.coordinates == "degrees":
        summary = f"outline of {counted(len(data.positions), 'point')}, longitude and latitude ({DATUM})"
    remove_place(path)
    format.writers[holds](data, path, colour or "db")
    beside = write_place(path, run.place) if run.place is not None and format.coordinates == "scene" else ""
    return Written(summary, format.opened_with[holds], beside)


@checks_arguments
def export_terrain(terrain: str | Path, path: str | Path, view: View) -> Written:
    """Write a map of layover and shadow on a GeoTIFF of heights, without a run.

    Parameters
    ----------
    terrain : str or Path
        GeoTIFF of heights, m, in a projected system in metres; pixels without data hide nothing.
    path : str or Path
        File to write, a .tif on the pixels and in the system of the terrain; an existing one is replaced.
    view : View
        View, whose azimuth is clockwise from the terrain's east.

    Raises
    ------
    SarsplatError
        If the terrain cannot be read, the path has another ending, the view is tilted, or the file cannot be written.
    """
    path = Path(path)
    format, holds = format_of(path, "layover-shadow")
    raster, summary = of_terrain(Path(terrain), view)
    format.writers[holds](raster, path, "db")
    return Written(summary, format.opened_with[holds])
