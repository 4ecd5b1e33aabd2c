"""Georeferenced rasters by GDAL (rasterio): heights, pictures, maps of runs, and the terrain of datasets."""

from __future__ import annotations

import io
import logging
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Float64, Shaped

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import open_file, write_bytes
from sarsplat.data.known_part import known_part
from sarsplat.data.map_place import place_on_map
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.extras import install_command
from sarsplat.geometry import Place, Terrain
from sarsplat.geometry.place import HeightAbove

HEIGHTS_ABOVE = "HEIGHTS_ABOVE"
"""Metadata item that names the zero level of heights: with a vertical system GDAL loses the horizontal one's number."""
LEVELS: dict[HeightAbove, str] = {
    "ellipsoid": "the WGS 84 ellipsoid",
    "sea level": "sea level",
    "unknown": "an unknown level",
}
"""Names of the zero levels of heights."""
_PIXEL_SCALE, _KEYS, _DOUBLES, _ORIENTATION = 33550, 34735, 34736, 274
_OWN_KEYS = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
"""GeoKeys of `terrain_bytes`: metres, of no known system."""
_UNIT_KEYS = {2054: (9102, "degrees"), 3076: (9001, "metres"), 4099: (9001, "metres")}
"""Keys of angular, linear and vertical units: their usual value, which GDAL assumes without a known system."""
_LOCAL = 'LOCAL_CS["scene",UNIT["metre",1]]'
_HIGHEST_M, _USUAL_HOLE = 12_000.0, -9999.0
"""Bound of the heights of the earth's surface, and the usual sentinel of holes."""
_HARMLESS, _MOST_PACKED = 1 << 27, 64
"""Pixels of any raster, and pixels per byte of its file; a raster of more than both is rejected."""
_EQUATOR_M = 6378137.0
"""Semi-major axis of the ellipsoids of WGS 84 and GRS 1980."""
_ELSEWHERE = {
    *("VRT", "WMS", "WCS", "WMTS", "GTI", "STACIT", "STACTA"),
    *("MRF", "DAAS", "EEDA", "EEDAI", "PLMOSAIC", "HTTP"),
}
"""Drivers of GDAL that follow a file to other files or to the net."""

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # sarsplat's errors describe damaged files


@dataclass(frozen=True, eq=False)
class Raster:
    """Numbers or classes over a map.

    Parameters
    ----------
    values : numpy.ndarray, float or uint8 [rows, columns]
        Row 0 has the largest y (north); NaN of floats means unknown.
    corner_m : (float, float)
        Least x and largest y of the map: the outer corner of its first pixel.
    pitch_m : (float, float)
        Size of a pixel along x and y.
    crs : pyproj.CRS or None
        System of x and y; None: the scene's own axes, in metres.
    height_above : {"ellipsoid", "sea level", "unknown"} or None
        Zero level of heights; None: the file does not name it, or heights are z of the scene.
    """

    values: Shaped[np.ndarray, "rows columns"]
    corner_m: tuple[float, float]
    pitch_m: tuple[float, float]
    crs: Any = None
    height_above: HeightAbove | None = None

    @property
    def centres(self) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
        """X and y of the middle of each pixel, m."""
        (rows, columns), (left, top), (dx, dy) = self.values.shape, self.corner_m, self.pitch_m
        x, y = np.meshgrid(left + (np.arange(columns) + 0.5) * dx, top - (np.arange(rows) + 0.5) * dy)
        return x, y


@dataclass(frozen=True, eq=False)
class MapHeights:
    """Heights on a map.

    Attributes
    ----------
    raster : Raster
        Heights, float64, m, NaN where unknown, in the file's system.
    place : Place or None
        Position of their middle on earth, if known.
    metres : (float, float)
        Metres on the ground for each metre of the map along its x and y; 1 if unknown.
    """

    raster: Raster
    place: Place | None
    metres: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Georeference:
    """Map coordinates of pixels.

    Parameters
    ----------
    affine : numpy.ndarray, float64 [2, 3]
        (x, y) of the middle of the pixel in a column and a row: `affine @ (column, row, 1)`, in the map's unit.
    crs : pyproj.CRS or None
        Horizontal system of x and y; None if the file names none.
    """

    affine: Float64[np.ndarray, "2 3"]
    crs: Any = None

    @property
    def geographic(self) -> bool:
        """True for longitude and latitude."""
        return self.crs is not None and self.crs.is_geographic

    @property
    def epsg(self) -> int | None:
        """Number of the system in EPSG's list."""
        number: int | None = None if self.crs is None else self.crs.to_epsg()
        return number

    @property
    def pitch(self) -> tuple[float, float]:
        """Distance of columns and of rows, in the map's unit."""
        (a, b, _), (d, e, _) = self.affine
        return math.hypot(a, d), math.hypot(b, e)

    @property
    def system(self) -> str:
        """Name of the map's system."""
        if self.crs is None or (number := self.epsg) is not None:
            return "no system" if self.crs is None else f"EPSG:{number}"
        return f"a {'geographic' if self.geographic else 'projected'} system without a number"


@contextmanager
def opened_raster(path: Path) -> Iterator[Any]:
    """Open a raster of any format by rasterio; every failure becomes a `SarsplatError`."""
    try:
        import pyproj  # noqa: F401 (callers need it)
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning
        from rasterio.io import DatasetReader
    except ImportError as error:
        raise SarsplatError(
            f"{path} needs rasterio and pyproj, which are not installed; {install_command('gis')}"
        ) from error
    with open_file(path) as file:
        size = file.seek(0, 2)
    try:
        with (
            warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning),
            # a world file says nothing of its unit
            rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_GEOREF_SOURCES="PAM,INTERNAL") as env,
            DatasetReader(str(path), driver=[*env.drivers().keys() - _ELSEWHERE]) as raster,
        ):
            block = max((math.prod(shape) for shape in raster.block_shapes), default=0)
            pixels = max(raster.width * raster.height * raster.count, block)
            if pixels > max(_HARMLESS, _MOST_PACKED * size):
                raise SarsplatError(f"{path} has {size} bytes but claims to hold {pixels} pixels; get it again")
            if raster.driver == "GTiff":
                _refuse_unread_tags(path, _system(raster))
            yield raster
    except SarsplatError:
        raise
    except Exception as error:  # GDAL raises errors of many types for garbled files
        raise SarsplatError(f"{path} is not a readable raster ({shown(str(error))}); get or write it again") from error


def _refuse_unread_tags(path: Path, crs: Any) -> None:
    """Raise if a TIFF's orientation or units, which GDAL ignores without a known system, are unusual."""
    with tifffile.TiffFile(path) as tiff:
        tags: Any = {tag.code: tag.value for tag in tiff.pages.first.tags.values()}
    if tags.get(_ORIENTATION, 1) != 1:
        raise SarsplatError(f"{path} is stored turned (orientation {int(tags[_ORIENTATION])}); write it upright")
    rows = np.reshape(tags.get(_KEYS, ())[4:], (-1, 4)).astype(int)
    stated = {key: value for key, place, _, value in rows.tolist() if place == 0}
    if 3076 in stated and ((crs is not None and crs.to_2d().to_epsg()) or 1.0 in np.ravel(tags.get(_DOUBLES, ()))):
        del stated[3076]  # GDAL knows the unit of a numbered system; an own unit may be one of 1 m
    for key, (usual, unit) in _UNIT_KEYS.items():
        if stated.get(key, 0) not in (0, usual):
            raise SarsplatError(
                f"{path} has another unit than {unit} (EPSG {stated[key]}); convert it, as by gdalwarp -t_srs"
            )


def georeference_of(raster: Any) -> Georeference | None:
    """Read the map coordinates of an open raster; None without any."""
    matrix = np.array(raster.transform, np.float64).reshape(3, 3)[:2]
    if raster.transform.is_identity or not np.linalg.det(matrix[:, :2]):
        return None
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5)
    return Georeference(matrix, _horizontal(_system(raster)))


def _system(raster: Any) -> Any:
    """Return the system of an open raster, heights included, as pyproj.CRS; None without one."""
    from pyproj import CRS

    return CRS.from_wkt(raster.crs.to_wkt(version="WKT2_2019")) if raster.crs else None


def _horizontal(crs: Any) -> Any:
    """Return the system without heights, by its EPSG number if it has one, which adds its area of use."""
    if crs is None:
        return None
    number = crs.to_2d().to_epsg()
    return crs.to_2d() if number is None else type(crs).from_epsg(number)


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
    heights, pitch, place = _read_own(path) or _read_foreign(path)
    try:
        return Terrain(np.ascontiguousarray(heights[::-1]), pitch, place)
    except SarsplatError as error:
        raise SarsplatError(f"{path}: {error}") from error


_Stored = tuple[Float64[np.ndarray, "rows columns"], tuple[float, float], Place | None]
"""Heights with row 0 in the north, pitch and place."""


def _read_foreign(path: Path) -> _Stored:
    """Read heights and pitch of any raster."""
    found = read_heights(path)
    (x, y), (on_x, on_y) = found.raster.pitch_m, found.metres
    return known_part(path, found.raster.values), (x * on_x, y * on_y), found.place


def _read_own(path: Path) -> _Stored | None:
    """Read heights and pitch by `write_terrain`; None if another program wrote or changed the file, or if damaged."""
    with open_file(path) as file:
        data = file.read()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            page: Any = tiff.pages.first
            uncompressed = page.compression == tifffile.COMPRESSION.NONE and page.size * 8 <= len(data)
            own = page.software == "sarsplat" and page.tags[_KEYS].value == _OWN_KEYS and 42112 not in page.tags
            if not own or page.dtype != np.float64 or page.ndim != 2 or not uncompressed:
                return None
            dx, dy, _ = map(float, page.tags[_PIXEL_SCALE].value)
            return page.asarray(), (dx, dy), None
    except Exception:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        return None


def read_heights(path: str | Path) -> MapHeights:
    """Read heights of a raster of one band, unknown ones as NaN; errors as for `read_terrain`."""
    path = Path(path)
    with opened_raster(path) as file:
        if file.count != 1:
            raise SarsplatError(f"{path} has {file.count} bands; give one of heights, as by gdal_translate -b 1")
        if np.dtype(file.dtypes[0]).kind not in "iuf":
            raise SarsplatError(f"{path} holds {file.dtypes[0]} numbers; give heights")
        crs, transform = _system(file), file.transform
        if crs is None and file.driver != "GTiff":
            raise SarsplatError(
                f"{path} names no coordinate system; give it one, as by gdal_translate -a_srs EPSG:NUMBER"
            )
        _refuse_units(path, crs, file.units[0])
        _refuse_turned(path, transform)
        values = file.read(1, masked=True).astype(np.float64).filled(np.nan) * file.scales[0] + file.offsets[0]
        level = file.tags().get(HEIGHTS_ABOVE)
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
    horizontal = None if crs is None or crs.is_engineering else _horizontal(crs)
    raster = Raster(values, (transform.c, top), pitch, horizontal, above)
    if horizontal is None or horizontal.to_epsg() is None:
        return MapHeights(raster, None, (1.0, 1.0))
    middle = transform.c + values.shape[1] / 2 * pitch[0], top - values.shape[0] / 2 * pitch[1]
    where = place_on_map(horizontal, middle, str(path), above or "unknown")
    return MapHeights(raster, where.place if where else None, where.metres if where else (1.0, 1.0))


def terrain_bytes(terrain: Terrain) -> bytes:
    """Encode terrain as a GeoTIFF that `read_terrain` reads to the same bits; its origin is the scene's."""
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
            (_KEYS, "H", len(_OWN_KEYS), _OWN_KEYS, True),
        ],
    )
    return buffer.getvalue()


@checks_arguments
def write_terrain(path: str | Path, terrain: Terrain) -> None:
    """Write terrain as a GeoTIFF, whole or not at all."""
    write_bytes(Path(path), terrain_bytes(terrain))


def write_raster(
    path: Path,
    raster: Raster,
    description: str,
    *,
    unit: str = "",
    colours: Mapping[int, tuple[int, int, int]] | None = None,
) -> None:
    """Write a raster as a tiled and compressed GeoTIFF, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    raster : Raster
        Numbers, which become float32 with NaN as "no data", or classes, with 255 as "no data".
    description : str
        Name of the quantity, with its unit (the ImageDescription tag, and the name of the band).
    unit : str, optional
        Unit of the band, for programs; none unless given.
    colours : mapping of int to (red, green, blue), optional
        Colours of classes, 0 to 255; without them the raster holds numbers.
    """
    try:
        import rasterio
    except ImportError as error:
        raise SarsplatError(f"{path} needs rasterio, which is not installed; {install_command('gis')}") from error
    (rows, columns), (left, top), (dx, dy) = raster.values.shape, raster.corner_m, raster.pitch_m
    kind, no_data = ("float32", math.nan) if colours is None else ("uint8", 255)
    packed = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=columns,
            height=rows,
            count=1,
            dtype=kind,
            nodata=no_data,
            crs=_LOCAL if raster.crs is None else raster.crs.to_wkt(),
            transform=rasterio.Affine(dx, 0, left, 0, -dy, top),
            **packed,
        ) as file:
            file.write(raster.values.astype(kind), 1)
            file.set_band_description(1, description)
            file.update_tags(TIFFTAG_SOFTWARE="sarsplat", TIFFTAG_IMAGEDESCRIPTION=description)
            if unit:
                file.set_band_unit(1, unit)
            if raster.height_above is not None:
                file.update_tags(**{HEIGHTS_ABOVE: LEVELS[raster.height_above]})
            if colours is not None:
                file.write_colormap(1, dict(colours))
        write_bytes(path, memory.getbuffer())


def _refuse_units(path: Path, crs: Any, unit: str | None) -> None:
    """Raise if coordinates or heights are not in metres, or are depths."""
    if unit and unit.lower() not in ("m", "metre", "meter", "metres", "meters"):
        raise SarsplatError(f"{path} has heights in {shown(unit)}; convert them to metres")
    if crs is None:
        return
    if crs.is_geographic:
        raise SarsplatError(
            f"{path} is in degrees of latitude and longitude; convert it to metres, as by "
            "gdalwarp -t_srs EPSG:326xx (the UTM zone)"
        )
    for axis in crs.axis_info:
        if axis.unit_conversion_factor != 1 or axis.direction == "down":
            raise SarsplatError(
                f"{path} is measured {axis.direction} in units called {axis.unit_name}; convert it to metres (upwards)"
            )


def _refuse_turned(path: Path, transform: Any) -> None:
    if transform.is_identity:
        raise SarsplatError(
            f"{path} has no pixel size; write it as a GeoTIFF in metres, as by "
            "gdal_translate -a_srs EPSG:326xx -a_ullr LEFT TOP RIGHT BOTTOM"
        )
    if transform.b or transform.d or transform.a < 0:
        raise SarsplatError(f"{path} is rotated against its system's axes; straighten it, as by gdalwarp")


def _height_above(crs: Any) -> HeightAbove | None:
    """Return the zero level of heights by a system's third axis; None without such an axis."""
    if crs is None or len(crs.axis_info) < 3:
        return None
    datum = next((part.datum for part in crs.sub_crs_list if part.is_vertical), None)
    if datum is not None:
        return "unknown" if not datum.name or "unknown" in datum.name or "ellipsoid" in datum.name else "sea level"
    return "ellipsoid" if crs.ellipsoid.semi_major_metre == _EQUATOR_M else "unknown"
