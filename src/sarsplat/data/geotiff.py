"""Terrain as a GeoTIFF: one band of heights, in a projected system in metres."""

from __future__ import annotations

import io
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import write_bytes
from sarsplat.data.foreign_tiff import (
    DOUBLES,
    GDAL_METADATA,
    KEYS,
    NO_DATA,
    PIXEL_SCALE,
    TEXTS,
    TIEPOINT,
    TRANSFORMATION,
    PageTags,
    gdal_items,
    opened_tiff,
    tags_of,
)
from sarsplat.data.georeference import (
    AREA,
    DEFINED_ELSEWHERE,
    GEOGRAPHIC,
    LENGTH,
    METRE,
    MODEL,
    POINT,
    RASTER,
    Georeference,
    georeference_of,
    keys_of,
)
from sarsplat.data.known_part import known_part
from sarsplat.data.map_place import MapPlace, height_above_of, place_on_map, refuse_vertical
from sarsplat.data.packed_tiff import masked_out, pixels_of
from sarsplat.data.raster import HEIGHTS_ABOVE, LEVELS, Raster, RasterSystem
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import Place, Terrain
from sarsplat.geometry.place import HeightAbove

_UNITS = {LENGTH: "lengths", 4099: "heights"}
_VERTICAL = 4096
_IN_FEET = (5702, 5754, 6130, 6131, 6132, 6360, 8050, 8052, 8228)
"""Numbers of EPSG's systems of heights in feet, for which GDAL writes no unit."""
_LENGTH_SIZE = 3077
_HIGHEST_M, _USUAL_HOLE = 12_000.0, -9999.0
"""No height of the earth's surface, above or below the sea, is beyond the first; the second marks holes everywhere."""
_TIMES, _HARMLESS = 64, 1 << 30
"""Heights that unpack to more than this many times the file's size, and to more bytes than that, are no heights."""


@checks_arguments
def read_terrain(path: str | Path) -> Terrain:
    """Heights of a GeoTIFF of one band: its middle at the origin, columns (east) along +x, rows upwards along +y.

    Parameters
    ----------
    path : str or Path
        In a projected system in metres. Nothing in it is trusted.

    Returns
    -------
    Terrain
        Heights as they are stored; `Terrain.centred` measures them from the origin. If its system has a number in
        EPSG's list, its `place` is that of the middle, x axis along the columns, and its pitch in metres on the ground,
        not in those of the map.

    Raises
    ------
    SarsplatError
        If it cannot be read, has several bands, is in degrees or feet, is turned, says nowhere how far its pixels are
        apart, has fewer than 2 × 2 heights, or there are some that are not known inside of it.

    Warns
    -----
    SarsplatWarning
        If its system has a number, but where that is cannot be found out, for instance without pyproj; or heights at
        its edges are not known, where it is cut, with the same middle.
    """
    path, found = Path(path), read_heights(path)
    heights, pitch = known_part(path, found.raster.values), found.raster.pitch_m
    on_ground = pitch[0] * found.metres[0], pitch[1] * found.metres[1]
    try:
        return Terrain(np.ascontiguousarray(heights[::-1]), on_ground, found.place)
    except SarsplatError as error:
        raise SarsplatError(f"{path}: {error}") from error


@dataclass(frozen=True, eq=False)
class MapHeights:
    """Heights on a map.

    Attributes
    ----------
    raster : Raster
        Heights, float64, m, NaN where they are not known, and where they lie in the file's own system.
    place : Place or None
        Where their middle is on earth, if that can be said.
    metres : (float, float)
        On the ground, for each metre of the map along its x and y; 1 if that is not known.
    """

    raster: Raster
    place: Place | None
    metres: tuple[float, float]


def read_heights(path: str | Path) -> MapHeights:
    """Heights of a GeoTIFF of one band as they are; refused as in `read_terrain`, but if some are not known."""
    path = Path(path)
    with opened_tiff(path, " with gdal_translate -co COMPRESS=NONE") as (tiff, data):
        page: Any = tiff.pages.first
        tags = tags_of(page)
        bands, shape = page.samplesperpixel, page.shape
        size = max(math.prod(shape), math.prod(page.chunks)) * np.dtype(page.dtype).itemsize
        allowed = max(_TIMES * len(data), _HARMLESS)
        heights = pixels_of(page, data, str(path)) if bands == 1 and size <= allowed else None
        absent = None if heights is None else masked_out(tiff, page, data, path)
    if bands != 1:
        raise SarsplatError(f"{path} has {bands} bands; give one of heights, as by gdal_translate -b 1")
    if heights is None or heights.ndim != 2 or heights.dtype.kind not in "iuf":
        raise SarsplatError(
            f"{path} holds {shown(page.dtype)} of shape {shown(shape)}; give heights in rows and columns"
        )
    _refuse_scaled(path, tags)
    pitch, upwards = _pitch(path, tags)
    lies = georeference_of(tags, str(path))
    where = _where(path, tags, lies, (heights.shape[0], heights.shape[1]))
    table = np.where(np.isfinite(heights), heights, np.nan).astype(np.float64)
    with suppress(TypeError, ValueError):  # it names none
        table[heights == float(tags.get(NO_DATA, "nan"))] = np.nan
    if absent is not None:
        table[absent] = np.nan
    _refuse_holes(path, table)
    first = -0.5, len(table) - 0.5 if upwards else -0.5  # the outer corner, column and row
    corner = (0.0, 0.0) if lies is None else tuple(map(float, lies.affine @ (*first, 1.0)))
    raster = Raster(table[::-1] if upwards else table, (corner[0], corner[1]), pitch, _system(tags))
    return MapHeights(raster, where.place if where else None, where.metres if where else (1.0, 1.0))


def terrain_bytes(terrain: Terrain) -> bytes:
    """A GeoTIFF that `read_terrain` reads to the same bits; the origin of its system is that of the scene."""
    (dx, dy), (half_x, half_y) = terrain.pitch_m, terrain.half_m
    keys = RasterSystem.local(POINT).keys
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        terrain.heights_m[::-1],
        photometric="minisblack",
        metadata=None,
        description="height of the ground, m; columns along x, rows from +y to -y",
        software="sarsplat",
        extratags=[
            (PIXEL_SCALE, "d", 3, (dx, dy, 0.0), True),
            (TIEPOINT, "d", 6, (0.0, 0.0, 0.0, -half_x, half_y, 0.0), True),
            (KEYS, "H", len(keys), keys, True),
        ],
    )
    return buffer.getvalue()


@checks_arguments
def write_terrain(path: str | Path, terrain: Terrain) -> None:
    """Write terrain as a GeoTIFF, whole or not at all."""
    write_bytes(Path(path), terrain_bytes(terrain))


def _refuse_scaled(path: Path, tags: PageTags) -> None:
    """Refuse numbers that are heights only with the scale, the offset or the unit of GDAL's metadata."""
    for role, usual in (("scale", 1.0), ("offset", 0.0)):
        for text in gdal_items(tags, role):
            with suppress(ValueError):
                if float(text) == usual:
                    continue
            raise SarsplatError(
                f"{path} holds numbers that become heights by their {role} of {shown(text)}, which is not applied; "
                "write the heights themselves, as by gdal_translate -unscale -ot Float32"
            )
    for text in gdal_items(tags, "unittype"):
        if text.strip().lower() not in ("", "m", "metre", "meter", "metres", "meters"):
            raise SarsplatError(f"{path} has heights in {shown(text)}; convert them to metres")


def _refuse_holes(path: Path, heights: Float64[np.ndarray, "rows columns"]) -> None:
    """Refuse numbers that mark holes, but are not said to."""
    with np.errstate(invalid="ignore"):
        odd = heights[(abs(heights) > _HIGHEST_M) | (heights == _USUAL_HOLE)]
    if len(odd):
        raise SarsplatError(
            f"{path} has {counted(len(odd), 'height')} that the earth does not have, such as {odd[0]:.9g} m; if that "
            f"means unknown, say so, as by gdal_translate -a_nodata {odd[0]:.9g}"
        )


def _pitch(path: Path, tags: PageTags) -> tuple[tuple[float, float], bool]:
    """Distances of pixels along x and y, m, and whether rows go upwards (north)."""
    keys = keys_of(tags)
    if keys.get(MODEL) == GEOGRAPHIC:
        raise SarsplatError(
            f"{path} is in degrees of latitude and longitude; bring it into metres, as by "
            "gdalwarp -t_srs EPSG:326xx (the UTM zone)"
        )
    for key, what in _UNITS.items():
        if keys.get(key, METRE) not in (METRE, DEFINED_ELSEWHERE):
            raise SarsplatError(
                f"{path} has {what} in another unit than metres (EPSG {keys[key]}); convert it to metres"
            )
    if keys.get(_VERTICAL) in _IN_FEET:
        raise SarsplatError(f"{path} has heights in feet (EPSG:{keys[_VERTICAL]}); convert them to metres")
    if _VERTICAL in keys:
        refuse_vertical(keys[_VERTICAL], str(path))
    if keys.get(LENGTH) == DEFINED_ELSEWHERE and (size := _length_m(tags)) not in (None, 1.0):
        raise SarsplatError(f"{path} has lengths in a unit of {size:g} m; convert it to metres")
    if TRANSFORMATION in tags:
        a, b, _, _, d, e, *_ = map(float, tags[TRANSFORMATION])
        if b or d:
            raise SarsplatError(f"{path} is turned against its system's axes; straighten it, as by gdalwarp")
        if a < 0:
            raise SarsplatError(f"{path} has columns that run west; straighten it, as by gdalwarp")
        pitch, upwards = (abs(a), abs(e)), e > 0
    elif PIXEL_SCALE in tags:
        scale = [float(number) for number in tags[PIXEL_SCALE]]
        if scale[0] < 0:
            raise SarsplatError(f"{path} has columns that run west; straighten it, as by gdalwarp")
        pitch, upwards = (scale[0], scale[1]), False
    else:
        raise SarsplatError(
            f"{path} does not say how far its pixels are apart; write it as a GeoTIFF in metres, as by "
            "gdal_translate -a_srs EPSG:326xx -a_ullr LEFT TOP RIGHT BOTTOM"
        )
    if not all(math.isfinite(length) and length > 0 for length in pitch):
        raise SarsplatError(f"{path}: its pitch_m is {pitch}; give two positive, finite numbers of metres (x, y)")
    return pitch, upwards


def _where(path: Path, tags: PageTags, lies: Georeference | None, shape: tuple[int, int]) -> MapPlace | None:
    """Where its middle is on earth, if its system has a number."""
    if lies is None or lies.kind != "projected" or lies.epsg is None:
        return None
    x, y = lies.affine @ ((shape[1] - 1) / 2, (shape[0] - 1) / 2, 1.0)
    return place_on_map(lies.epsg, (float(x), float(y)), str(path), _height_above(tags) or "unknown")


def _height_above(tags: PageTags) -> HeightAbove | None:
    """What the file says that heights are measured from: by a vertical system, or as our own maps say it."""
    if (code := keys_of(tags).get(_VERTICAL)) is not None:
        return height_above_of(code)
    said = str(tags.get(GDAL_METADATA, ""))
    return next((name for name, level in LEVELS.items() if f'"{HEIGHTS_ABOVE}">{level}<' in said), None)


def _system(tags: PageTags) -> RasterSystem:
    """What the file says of its coordinates, as it says it, but for pixels, which are areas in rasters of ours."""
    numbers = [int(number) for number in tags.get(KEYS, ())]
    for k in range(4, len(numbers) - 3, 4):
        if numbers[k] == RASTER:
            numbers[k + 3] = AREA
    doubles = tuple(map(float, np.atleast_1d(tags.get(DOUBLES, ()))))
    return RasterSystem(tuple(numbers), doubles, str(tags.get(TEXTS, "")), height_above=_height_above(tags))


def _length_m(tags: PageTags) -> float | None:
    """Length of a unit that the file itself defines, m, if it does."""
    index, doubles = keys_of(tags, DOUBLES).get(_LENGTH_SIZE), np.atleast_1d(tags.get(DOUBLES, ()))
    return None if index is None or index >= len(doubles) else float(doubles[index])
