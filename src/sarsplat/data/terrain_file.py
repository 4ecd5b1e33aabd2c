"""Terrain in files: heights of the ground in GeoTIFFs and other rasters."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Bool, Float64

from sarsplat.arguments import checks_arguments
from sarsplat.data import geotiff
from sarsplat.data.files import read_bytes, write_bytes
from sarsplat.data.geotiff import LEVELS, Raster
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.geometry import Place, Terrain
from sarsplat.geometry.place import HeightAbove

_PIXEL_SCALE = 33550
_OWN_KEYS = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
"""GeoKeys of `write_terrain`: metres, of no known system."""
_HIGHEST_M, _USUAL_HOLE = 12_000.0, -9999.0
"""Bound of the heights of the earth's surface, and the usual sentinel of holes."""
_EQUATOR_M = 6378137.0  # semi-major axis of the ellipsoids of WGS 84 and GRS 1980
_METRES = ("", "m", "metre", "meter", "metres", "meters")


@dataclass(frozen=True, eq=False)
class MapHeights:
    """Heights on a map."""

    raster: Raster
    """Heights, float64, m, NaN where unknown, in the file's system."""
    place: Place | None = None
    """Position of their middle on earth, if known."""
    metres: tuple[float, float] = (1.0, 1.0)
    """Metres on the ground for each metre of the map along its x and y; 1 if unknown."""


@checks_arguments
def read_terrain(path: str | Path) -> Terrain:
    """Read heights of a raster of one band: its middle at the origin, columns (east) along +x, rows upwards along +y.

    Parameters
    ----------
    path : str or Path
        GeoTIFF, or any raster that GDAL reads, in a projected system in metres.

    Returns
    -------
    Terrain
        Heights as stored; `Terrain.centred` measures them from the origin. If its system has an EPSG number, `place` is
        the middle, x axis along the columns, and the pitch is in metres on the ground, not on the map.

    Raises
    ------
    SarsplatError
        If it cannot be read, has several bands, is in degrees or feet, is rotated, has no pixel size, has fewer than
        2 × 2 heights, or unknown ones inside; or rasterio is missing (files by `write_terrain` do not need it).

    Warns
    -----
    SarsplatWarning
        If its system has a known EPSG number but no place on earth is found, or unknown heights at its edges are cut
        off.
    """
    path = Path(path)
    if (own := _read_own(path)) is not None:
        heights, pitch, place = *own, None
    else:
        found = read_heights(path)
        (x, y), (on_x, on_y) = found.raster.pitch_m, found.metres
        heights, pitch, place = _known_part(path, found.raster.values), (x * on_x, y * on_y), found.place
    try:
        return Terrain(np.ascontiguousarray(heights[::-1]), pitch, place)
    except SarsplatError as error:
        raise SarsplatError(f"{path}: {error}") from error


def _read_own(path: Path) -> tuple[Float64[np.ndarray, "rows columns"], tuple[float, float]] | None:
    """Read heights, row 0 north, and pitch by `write_terrain`; None if damaged or written by another program."""
    data = read_bytes(path)
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            page: Any = tiff.pages.first
            uncompressed = page.compression == tifffile.COMPRESSION.NONE and page.size * 8 <= len(data)
            own = page.software == "sarsplat" and page.tags[geotiff.KEYS].value == _OWN_KEYS and 42112 not in page.tags
            if not own or page.dtype != np.float64 or page.ndim != 2 or not uncompressed:
                return None
            dx, dy, _ = map(float, page.tags[_PIXEL_SCALE].value)
            return page.asarray(), (dx, dy)
    except Exception:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        return None


def read_heights(path: str | Path) -> MapHeights:
    """Read heights of a raster of one band, unknown ones as NaN; errors as for `read_terrain`."""
    path = Path(path)
    with geotiff.opened_raster(path) as file:
        if file.count != 1 or np.dtype(file.dtypes[0]).kind not in "iuf":
            raise SarsplatError(
                f"{path} has {counted(file.count, 'band')} of {file.dtypes[0]}; give one of heights, as by "
                "gdal_translate -b 1"
            )
        crs, transform = geotiff.system_of(file), file.transform
        if crs is None and file.driver != "GTiff":
            raise SarsplatError(f"{path} names no coordinate system; give it one by gdal_translate -a_srs EPSG:NUMBER")
        _refuse_units(path, crs, file.units[0])
        if transform.is_identity:
            raise SarsplatError(
                f"{path} has no pixel size; give it one by gdal_translate -a_srs EPSG:326xx -a_ullr LEFT TOP RIGHT "
                "BOTTOM"
            )
        if transform.b or transform.d or transform.a < 0:
            raise SarsplatError(f"{path} is rotated against its system's axes; straighten it, as by gdalwarp")
        values = file.read(1, masked=True).astype(np.float64).filled(np.nan) * file.scales[0] + file.offsets[0]
        level = file.tags().get(geotiff.HEIGHTS_ABOVE)
    values[~np.isfinite(values)] = np.nan
    odd = values[(np.abs(values) > _HIGHEST_M) | (values == _USUAL_HOLE)]
    if len(odd):
        raise SarsplatError(
            f"{path} has {counted(len(odd), 'height')} beyond the earth's, such as {odd[0]:.9g} m; if that means "
            f"unknown, set it as no data, as by gdal_translate -a_nodata {odd[0]:.9g}"
        )
    top = transform.f
    if transform.e > 0:  # rows go upwards (north)
        values, top = values[::-1], top + len(values) * transform.e
    pitch = transform.a, abs(transform.e)
    above = next((name for name, text in LEVELS.items() if text == level), None) or _height_above(crs)
    horizontal = None if crs is None or crs.is_engineering else geotiff.horizontal_system(crs)
    raster = Raster(values, (transform.c, top), pitch, horizontal, above)
    if horizontal is None or horizontal.to_epsg() is None:
        return MapHeights(raster)
    middle = transform.c + values.shape[1] / 2 * pitch[0], top - values.shape[0] / 2 * pitch[1]
    return MapHeights(raster, *(geotiff.place_on_map(horizontal, middle, str(path), above or "unknown") or ()))


def _refuse_units(path: Path, crs: Any, unit: str | None) -> None:
    """Raise if coordinates or heights are not in metres, or are depths."""
    axes = [] if crs is None else crs.axis_info
    wrong = [
        f"{axis.direction} in units called {axis.unit_name}"
        for axis in axes
        if axis.unit_conversion_factor != 1 or axis.direction == "down" or crs.is_geographic
    ]
    if (unit or "").lower() not in _METRES:
        wrong.append(f"upwards in {shown(unit)}")
    if wrong:
        degrees = "degree" in wrong[0]  # gdalwarp leaves heights as they are
        how = "gdalwarp -t_srs EPSG:326xx (the UTM zone)" if degrees else "gdal_calc for heights, gdalwarp for the rest"
        raise SarsplatError(f"{path} is measured {wrong[0]}; convert all of it to metres (upwards), as by {how}")


def _height_above(crs: Any) -> HeightAbove | None:
    """Return the zero level of heights by a system's third axis; None without such an axis."""
    if crs is None or len(crs.axis_info) < 3:
        return None
    datum = next((part.datum for part in crs.sub_crs_list if part.is_vertical), None)
    if datum is not None:
        return "unknown" if not datum.name or "unknown" in datum.name or "ellipsoid" in datum.name else "sea level"
    return "ellipsoid" if crs.ellipsoid.semi_major_metre == _EQUATOR_M else "unknown"


def _known_part(path: Path, heights: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "fewer less"]:
    """Return the largest part with the same middle and without NaN: reprojected rasters have wedges along their edges.

    Raise if NaNs form a hole inside, or fewer than 2 × 2 heights are left; warn if something is cut off.
    """
    unknown = np.isnan(heights)
    if not unknown.any():
        return heights
    holes = holes_of(unknown)
    rows, columns = _margins(unknown)
    part = heights[rows : len(heights) - rows, columns : heights.shape[1] - columns]
    if holes.any() or min(part.shape) < 2:
        holes = holes if holes.any() else unknown
        (first, last), (left, right) = ((int(at.min()) + 1, int(at.max()) + 1) for at in np.nonzero(holes))
        raise SarsplatError(
            f"{path} has {counted(int(holes.sum()), 'unknown height')} of {heights.size}, within rows {first} to "
            f"{last} and columns {left} to {right}; fill them in, as by gdal_fillnodata, or cut them off"
        )
    warnings.warn(
        f"{path} has {counted(int(unknown.sum()), 'unknown height')} of {heights.size} at its edges; it is cut by "
        f"{counted(rows, 'row')} above and below and {counted(columns, 'column')} left and right, and its new edges "
        "are continued outwards",
        SarsplatWarning,
        stacklevel=4,
    )
    return part


def holes_of(unknown: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Return the unknown heights that are not connected to an edge."""
    from scipy.ndimage import label  # slow to import, and rarely needed

    parts, _ = label(unknown, np.ones((3, 3)))
    edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return unknown & ~np.isin(parts, edges)


def _margins(unknown: Bool[np.ndarray, "rows columns"]) -> tuple[int, int]:
    """Return the rows and columns to cut off on both sides, so that the largest known part is left."""
    rows, columns = unknown.shape
    row, column = np.nonzero(unknown)
    deepest = np.zeros((rows + 1) // 2 + 1, np.int64)  # columns to cut, by how many rows are
    np.maximum.at(deepest, np.minimum(row, rows - 1 - row), np.minimum(column, columns - 1 - column) + 1)
    deepest = np.maximum.accumulate(deepest[::-1])[::-1]
    area = np.maximum(rows - 2 * np.arange(len(deepest)), 0) * np.maximum(columns - 2 * deepest, 0)
    best = int(area.argmax())
    return best, int(deepest[best])


@checks_arguments
def write_terrain(path: str | Path, terrain: Terrain) -> None:
    """Write terrain as a GeoTIFF that `read_terrain` reads to the same bits, whole or not at all."""
    (dx, dy), (half_x, half_y) = terrain.pitch_m, terrain.half_m
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
            (33922, "d", 6, (0.0, 0.0, 0.0, -half_x, half_y, 0.0), True),
            (geotiff.KEYS, "H", len(_OWN_KEYS), _OWN_KEYS, True),
        ],
    )
    write_bytes(Path(path), buffer.getvalue())
