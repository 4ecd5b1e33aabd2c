"""Lengths of pictures: what the table and options say, beside what GeoTIFF tags say."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from sarsplat.data.geotiff import Georeference
from sarsplat.data.orientation import SIDES
from sarsplat.errors import SarsplatError
from sarsplat.importers.files import warn_caller
from sarsplat.importers.table import ListedPicture
from sarsplat.names import Side

_SAME = 0.01
"""Relative difference of lengths that are rounded."""

Stated = tuple[float | None, float | None]


def refuse_map(name: str, georeference: Georeference) -> None:
    """Refuse a picture that lies on a map, if nothing was said of that."""
    raise SarsplatError(
        f"{name} is geocoded ({georeference.system}): its rows and columns are those of a map, not range and azimuth; "
        "say what its producer took for the ground, --geocoded level or --geocoded terrain with --terrain FILE, and it "
        "is resampled, or save it without its GeoTIFF tags if these are wrong"
    )


def warn_of_world_files(paths: Iterable[Path]) -> None:
    """Say what it means that a picture without tags has a world file beside it, a.tfw or a.wld of a.tif; once."""
    for path in paths:
        ending = path.suffix
        for own in (f"{ending[:2]}{ending[-1]}w", f"{ending}w", ".wld"):
            if path.with_suffix(own).is_file():
                warn_caller(
                    f"{path.name} has the world file {path.stem}{own} beside it, by which its rows and columns are "
                    "those of a map, not range and azimuth; if they are, make a GeoTIFF of it, as by gdal_translate "
                    "-a_srs EPSG:NUMBER, and import that with --geocoded"
                )
                return


def spacing_beside(name: str, georeference: Georeference, near: Side, stated: Stated) -> Stated:
    """Spacing (azimuth, range) by what is stated, or else by the tags of a picture whose side `near` is near range.

    Refused if they contradict each other.
    """
    columns, rows = georeference.pitch
    pitch = (columns, rows) if SIDES.index(near) % 2 == 0 else (rows, columns)
    check_spacing(name, pitch, stated, "azimuth × range")
    azimuth, slant_range = (own if given is None else given for own, given in zip(pitch, stated, strict=True))
    return azimuth, slant_range


def check_spacing(name: str, pitch: tuple[float, float], stated: Stated, axes: str) -> None:
    """Refuse a spacing that is not that of the picture's tags."""
    if any(given is not None and abs(given / own - 1) > _SAME for own, given in zip(pitch, stated, strict=True)):
        given = " × ".join("–" if one is None else f"{one:.5g}" for one in stated)
        raise SarsplatError(
            f"{name} says that its pixels are {pitch[0]:.5g} m × {pitch[1]:.5g} m ({axes}), but {given} is given; "
            "leave out the spacing, or correct one of them"
        )


def lengths(table: Path, picture: ListedPicture, what: str, stated: Stated, slant: float) -> tuple[float, float]:
    """Spacing or resolution (azimuth, range), m; those in range are `slant` times as long as they are stated."""
    azimuth, slant_range = stated
    if azimuth is None or slant_range is None:
        raise SarsplatError(
            f"{table} does not say what the pixel {what} of {picture.name} is; give it with --{what}, or name its "
            f"column with --columns {what}=NAME"
        )
    return azimuth, slant_range * slant
