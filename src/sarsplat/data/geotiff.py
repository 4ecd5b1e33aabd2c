"""Terrain as a GeoTIFF: one band of heights, in a projected system in metres."""

from __future__ import annotations

import io
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import open_file, write_bytes
from sarsplat.data.raster import Raster, RasterSystem
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import Terrain

_PIXEL_SCALE, _TIEPOINT, _TRANSFORMATION, _NO_DATA = 33550, 33922, 34264, 42113
_KEYS, _DOUBLES, _TEXTS = 34735, 34736, 34737
_MODEL, _PROJECTED, _GEOGRAPHIC = 1024, 1, 2
_RASTER, _POINTS = 1025, 2
_UNITS = {3076: "lengths", 4099: "heights"}
_METRE, _DEFINED_ELSEWHERE = 9001, 32767
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
        Heights as they are stored; `Terrain.centred` measures them from the origin.

    Raises
    ------
    SarsplatError
        If it cannot be read, has several bands, is in degrees or feet, is turned, says nowhere how far its pixels are
        apart, has fewer than 2 × 2 heights, or there are some that are not known.
    """
    path, heights = Path(path), read_heights(path)
    unknown = int(np.isnan(heights.values).sum())
    if unknown:
        raise SarsplatError(
            f"{path} has {counted(unknown, 'height')} of {heights.values.size} that {'is' if unknown == 1 else 'are'} "
            "not known; fill them in, as by gdal_fillnodata, or cut them off"
        )
    try:
        return Terrain(np.ascontiguousarray(heights.values[::-1]), heights.pitch_m)
    except SarsplatError as error:
        raise SarsplatError(f"{path}: {error}") from error


def read_heights(path: str | Path) -> Raster:
    """Heights of a GeoTIFF of one band, float64, as a map: NaN where they are not known.

    Refused as in `read_terrain`, but for unknown heights.
    """
    path = Path(path)
    with open_file(path) as file:
        data = file.read()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            page: Any = tiff.pages.first
            tags = {tag.code: tag.value for tag in page.tags.values()}
            bands, shape = page.samplesperpixel, page.shape
            size = math.prod(shape) * np.dtype(page.dtype).itemsize
            heights = page.asarray(maxworkers=1) if bands == 1 and size <= max(_TIMES * len(data), _HARMLESS) else None
    except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        raise SarsplatError(
            f"{path} is not a readable TIFF ({shown(str(error))}); write it again with gdal_translate -co COMPRESS=NONE"
        ) from error
    if bands != 1:
        raise SarsplatError(f"{path} has {bands} bands; give one of heights, as by gdal_translate -b 1")
    if heights is None or heights.ndim != 2 or heights.dtype.kind not in "iuf":
        raise SarsplatError(
            f"{path} holds {shown(page.dtype)} of shape {shown(shape)}; give heights in rows and columns"
        )
    pitch, upwards = _pitch(path, tags)
    table = heights.astype(np.float64)
    table[~np.isfinite(heights)] = np.nan
    with suppress(TypeError, ValueError):  # it names none
        table[heights == float(tags.get(_NO_DATA, "nan"))] = np.nan
    try:
        corner = _corner(tags, pitch, len(table) if upwards else 0)
    except (TypeError, ValueError) as error:
        raise SarsplatError(f"{path} does not say where it is; write it again with gdal_translate") from error
    return Raster(table[::-1] if upwards else table, corner, pitch, _system(tags))


def terrain_bytes(terrain: Terrain) -> bytes:
    """A GeoTIFF that `read_terrain` reads to the same bits; the origin of its system is that of the scene."""
    (dx, dy), (half_x, half_y) = terrain.pitch_m, terrain.half_m
    keys = (1, 1, 0, 4, _MODEL, 0, 1, _PROJECTED, 1025, 0, 1, 2, 3072, 0, 1, _DEFINED_ELSEWHERE, 3076, 0, 1, _METRE)
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        terrain.heights_m[::-1],
        photometric="minisblack",
        metadata=None,
        description="height of the ground, m; columns along x, rows from +y to -y",
        software="sarsplat",
        extratags=[
            (_PIXEL_SCALE, "d", 3, (dx, dy, 0.0), True),
            (_TIEPOINT, "d", 6, (0.0, 0.0, 0.0, -half_x, half_y, 0.0), True),
            (_KEYS, "H", len(keys), keys, True),
        ],
    )
    return buffer.getvalue()


@checks_arguments
def write_terrain(path: str | Path, terrain: Terrain) -> None:
    """Write terrain as a GeoTIFF, whole or not at all."""
    write_bytes(Path(path), terrain_bytes(terrain))


def _pitch(path: Path, tags: dict[int, Any]) -> tuple[tuple[float, float], bool]:
    """Distances of pixels along x and y, m, and whether rows go upwards (north)."""
    keys = _keys(tags)
    if keys.get(_MODEL) == _GEOGRAPHIC:
        raise SarsplatError(
            f"{path} is in degrees of latitude and longitude; bring it into metres, as by "
            "gdalwarp -t_srs EPSG:326xx (the UTM zone)"
        )
    for key, what in _UNITS.items():
        if keys.get(key, _METRE) not in (_METRE, _DEFINED_ELSEWHERE):
            raise SarsplatError(
                f"{path} has {what} in another unit than metres (EPSG {keys[key]}); convert it to metres"
            )
    if _TRANSFORMATION in tags:
        a, b, _, _, d, e, *_ = map(float, tags[_TRANSFORMATION])
        if b or d:
            raise SarsplatError(f"{path} is turned against its system's axes; straighten it, as by gdalwarp")
        pitch, upwards = (abs(a), abs(e)), e > 0
    elif _PIXEL_SCALE in tags:
        scale = [float(number) for number in tags[_PIXEL_SCALE]]
        pitch, upwards = (scale[0], scale[1]), False
    else:
        raise SarsplatError(
            f"{path} does not say how far its pixels are apart; write it as a GeoTIFF in metres, as by "
            "gdal_translate -a_srs EPSG:326xx -a_ullr LEFT TOP RIGHT BOTTOM"
        )
    return pitch, upwards


def _corner(tags: dict[int, Any], pitch_m: tuple[float, float], row: int) -> tuple[float, float]:
    """Where the outer corner of the first column is, in this row; where heights are of points, half a pixel outside."""
    keys = _keys(tags)
    if _TRANSFORMATION in tags:
        _, _, _, x, _, e, _, y, *_ = map(float, tags[_TRANSFORMATION])
        x, y = x, y + e * row
    else:
        column_0, row_0, _, x, y, *_ = map(float, tags.get(_TIEPOINT, (0,) * 6))
        x, y = x - column_0 * pitch_m[0], y + row_0 * pitch_m[1]
    if keys.get(_RASTER) == _POINTS:
        x, y = x - pitch_m[0] / 2, y + pitch_m[1] / 2
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError("not finite")
    return x, y


def _system(tags: dict[int, Any]) -> RasterSystem:
    """What the file says of its coordinates, as it says it; that its heights are of areas, as rasters of ours are."""
    numbers = [int(number) for number in tags.get(_KEYS, ())]
    for k in range(4, len(numbers) - 3, 4):
        if numbers[k] == _RASTER:
            numbers[k + 3] = 1
    doubles = tags.get(_DOUBLES, ())
    return RasterSystem(
        tuple(numbers),
        tuple(map(float, doubles if isinstance(doubles, tuple) else (doubles,))),
        str(tags.get(_TEXTS, "")),
    )


def _keys(tags: dict[int, Any]) -> dict[int, int]:
    """GeoTIFF's keys that are numbers."""
    numbers = [int(number) for number in tags.get(_KEYS, ())]
    return {key: value for key, place, _, value in zip(*(numbers[4 + k :: 4] for k in range(4))) if place == 0}
