"""Georeferenced rasters by GDAL (rasterio), their map coordinates, and the place on earth of a point on a map."""

from __future__ import annotations

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

from sarsplat.data.files import open_file, write_bytes
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.extras import needed
from sarsplat.geometry import Place
from sarsplat.geometry.place import HeightAbove, geodetic_of_ecef

HEIGHTS_ABOVE = "HEIGHTS_ABOVE"
"""Metadata item that names the zero level of heights: with a vertical system GDAL loses the horizontal one's number."""
LEVELS: dict[HeightAbove, str] = {
    "ellipsoid": "the WGS 84 ellipsoid",
    "sea level": "sea level",
    "unknown": "an unknown level",
}
"""Names of the zero levels of heights."""
KEYS = 34735
"""Tag of GeoKeys in TIFFs."""
_DOUBLES, _ORIENTATION, _SAMPLES = 34736, 274, 339
UNDEFINED = 4
"""Sample format of a TIFF whose numbers have no stated meaning."""
_UNIT_KEYS = {2054: (9102, "degrees"), 3076: (9001, "metres"), 4099: (9001, "metres")}
"""Keys of angular, linear and vertical units: their usual value, which GDAL assumes without a known system."""
_LOCAL = 'LOCAL_CS["scene",UNIT["metre",1]]'
_HARMLESS, _MOST_PACKED = 1 << 27, 64
"""Pixels of any raster, and pixels per byte of its file; a raster of more than both is rejected."""
_ELSEWHERE = {
    *("VRT", "WMS", "WCS", "WMTS", "GTI", "STACIT", "STACTA"),
    *("MRF", "DAAS", "EEDA", "EEDAI", "PLMOSAIC", "HTTP"),
}
"""Drivers of GDAL that follow a file to other files or to the net."""

_STEP_M = 50.0  # distance over which a map's axes are compared with east and north
_SKEWED = 1e-3  # maximum cosine of the angle between a map's axes on the ground
INEXACT_M = 1.0
"""Minimum error of a conversion to WGS 84 that is reported; ETRS89 and its like are more exact."""
NOT_RELATED = (
    "no installed transformation relates its datum to WGS 84, and they can differ by some hundred metres; convert it "
    "to WGS 84, as by gdalwarp -t_srs EPSG:326xx (the UTM zone)"
)
UNCONVERTED = (
    "heights are not converted: levels can differ by about 100 m, and gdalwarp -s_srs EPSG:326xx+5773 (EGM96; +3855 "
    "EGM2008, +5703 NAVD88) -t_srs EPSG:4979, then -s_srs EPSG:4326 -t_srs EPSG:326xx, makes them ellipsoidal"
)
"""Sentence about heights above sea level."""

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # sarsplat's errors describe damaged files


@dataclass(frozen=True, eq=False)
class Raster:
    """Numbers or classes over a map."""

    values: Shaped[np.ndarray, "rows columns"]
    """Float or uint8; row 0 has the largest y (north), and NaN means unknown."""
    corner_m: tuple[float, float]
    """Least x and largest y of the map: the outer corner of its first pixel."""
    pitch_m: tuple[float, float]
    """Size of a pixel along x and y."""
    crs: Any = None
    """System of x and y, pyproj.CRS; None: the scene's own axes, in metres."""
    height_above: HeightAbove | None = None
    """Zero level of heights; None: the file does not name it, or heights are z of the scene."""

    @property
    def centres(self) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
        """X and y of the middle of each pixel, m."""
        (rows, columns), (left, top), (dx, dy) = self.values.shape, self.corner_m, self.pitch_m
        x, y = np.meshgrid(left + (np.arange(columns) + 0.5) * dx, top - (np.arange(rows) + 0.5) * dy)
        return x, y


@dataclass(frozen=True, eq=False)
class Georeference:
    """Map coordinates of pixels."""

    affine: Float64[np.ndarray, "2 3"]
    """(x, y) of the middle of the pixel in a column and a row: `affine @ (column, row, 1)`, in the map's unit."""
    crs: Any = None
    """Horizontal system of x and y, pyproj.CRS; None if the file names none."""

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
        if self.crs is not None and self.epsg is None:
            return f"a {'geographic' if self.geographic else 'projected'} system without a number"
        return "no system" if self.crs is None else f"EPSG:{self.epsg}"


def _rasterio(path: Path) -> Any:
    with needed("gis", str(path)):
        import pyproj  # noqa: F401 (callers need it)
        import rasterio
    return rasterio


@contextmanager
def opened_raster(path: Path) -> Iterator[Any]:
    """Open a raster of any format by rasterio; every failure becomes a `SarsplatError`."""
    rasterio = _rasterio(path)
    with open_file(path) as file:
        size = file.seek(0, 2)
    try:
        with (
            warnings.catch_warnings(action="ignore", category=rasterio.errors.NotGeoreferencedWarning),
            # a world file says nothing of its unit
            rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_GEOREF_SOURCES="PAM,INTERNAL") as env,
            rasterio.io.DatasetReader(str(path), driver=[*env.drivers().keys() - _ELSEWHERE]) as raster,
        ):
            block = max((math.prod(shape) for shape in raster.block_shapes), default=0)
            pixels = max(raster.width * raster.height * raster.count, block)
            if pixels > max(_HARMLESS, _MOST_PACKED * size):
                raise SarsplatError(f"{path} has {size} bytes but claims to hold {pixels} pixels; get it again")
            if raster.driver == "GTiff":
                _refuse_unread_tags(path, system_of(raster))
            yield raster
    except SarsplatError:
        raise
    except Exception as error:  # GDAL raises errors of many types for garbled files
        raise SarsplatError(f"{path} is not a readable raster ({shown(str(error))}); get or write it again") from error


def _refuse_unread_tags(path: Path, crs: Any) -> None:
    """Raise if a TIFF's samples, orientation or units, which GDAL ignores without a known system, are unusual."""
    try:
        with tifffile.TiffFile(path) as tiff:
            tags: Any = {tag.code: tag.value for tag in tiff.pages.first.tags.values()}
            known = tiff.pages.first.dtype is not None and UNDEFINED not in np.ravel(tags.get(_SAMPLES, 1))
    except TypeError:  # of numpy, which has no such type
        known, tags = False, {}
    refuse_turned(path, int(tags.get(_ORIENTATION, 1)))
    rows = np.reshape(tags.get(KEYS, ())[4:], (-1, 4)).astype(int)
    stated = {key: value for key, place, _, value in rows.tolist() if place == 0}
    if 3076 in stated and ((crs is not None and crs.to_2d().to_epsg()) or 1.0 in np.ravel(tags.get(_DOUBLES, ()))):
        del stated[3076]  # GDAL knows the unit of a numbered system; an own unit may be one of 1 m
    problems = [
        f"another unit than {unit} (EPSG {stated[key]}); convert it, as by gdalwarp -t_srs"
        for key, (usual, unit) in _UNIT_KEYS.items()
        if stated.get(key, 0) not in (0, usual)
    ]
    if not known:
        problems = [
            "samples of an undefined format, or complex ones of 8 or packed 16 bits; write float32 or complex64"
        ]
    if problems:
        raise SarsplatError(f"{path} has {problems[0]}")


def refuse_turned(path: Path, orientation: object) -> None:
    """Raise unless the orientation of a TIFF's or a camera's tag is upright."""
    if orientation not in (0, 1):  # unset, upright
        raise SarsplatError(f"{path} is stored turned (orientation {shown(orientation)}); write it upright")


def georeference_of(raster: Any) -> Georeference | None:
    """Read the map coordinates of an open raster; None without any."""
    matrix = np.array(raster.transform, np.float64).reshape(3, 3)[:2]
    if raster.transform.is_identity or not np.linalg.det(matrix[:, :2]):
        return None
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5)
    return Georeference(matrix, horizontal_system(system_of(raster)))


def system_of(raster: Any) -> Any:
    """Return the system of an open raster, heights included, as pyproj.CRS; None without one."""
    from pyproj import CRS

    return CRS.from_wkt(raster.crs.to_wkt(version="WKT2_2019")) if raster.crs else None


def horizontal_system(crs: Any) -> Any:
    """Return the system without heights, by its EPSG number if it has one, which adds its area of use."""
    if crs is None:
        return None
    number = crs.to_2d().to_epsg()
    return crs.to_2d() if number is None else type(crs).from_epsg(number)


def write_raster(
    path: Path,
    raster: Raster,
    description: str,
    *,
    unit: str = "",
    colours: Mapping[int, tuple[int, int, int]] | None = None,
) -> None:
    """Write a raster as a tiled and compressed GeoTIFF, whole or not at all.

    Numbers become float32 with NaN as "no data"; classes, which have `colours` (red, green, blue; 0 to 255), become
    uint8 with 255 as "no data". `description` names the quantity and its unit, in the ImageDescription tag and as the
    name of the band; `unit` is that of the band, for programs.
    """
    rasterio = _rasterio(path)
    (rows, columns), (left, top), (dx, dy) = raster.values.shape, raster.corner_m, raster.pitch_m
    kind, no_data = ("float32", math.nan) if colours is None else ("uint8", 255)
    packed = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "bigtiff": "if_safer"}
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


def place_on_map(
    crs: Any, at: tuple[float, float], name: str, height_above: HeightAbove = "unknown"
) -> tuple[Place, tuple[float, float]] | None:
    """Locate a point (x, y) of a projected EPSG system on earth; None, with a warning about `name`, if that fails.

    Returns its place at height 0, x axis along the map's, and the metres on the ground for each unit of the map along
    x and y.
    """
    from pyproj import Transformer

    system = f"{name} has map coordinates (EPSG:{crs.to_epsg()})"
    steps = _STEP_M * np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    transformer: Any = Transformer.from_crs(crs, "EPSG:4978", always_xy=True)
    corners = np.transpose(transformer.transform(*(np.asarray(at) + steps).T, np.zeros(len(steps))))
    if (exact_m := exactness_m(transformer)) is None:
        _warn(f"{system}, but its place on earth stays unknown: {NOT_RELATED}")
        return None
    if exact_m > INEXACT_M:
        _warn(f"{system} that convert to WGS 84 to within {exact_m:g} m")
    if not np.isfinite(corners).all():
        _warn(f"{system}, but ({at[0]:.10g}, {at[1]:.10g}) is outside of that system; its place stays unknown")
        return None
    latitude, longitude, _ = map(float, geodetic_of_ecef(corners[0]))
    level = Place(latitude, longitude, 0.0)  # x to the east
    along = (level.from_ecef(corners)[1:3, :2] - level.from_ecef(corners)[3:5, :2]) / (2 * _STEP_M)
    metres = np.linalg.norm(along, axis=1)
    if not abs(along[0] @ along[1]) < _SKEWED * math.prod(metres) or not np.linalg.det(along) > 0:
        _warn(f"{system}, whose axes are not at right angles there: its place stays unknown; warp it to a UTM zone")
        return None
    bearing = 90.0 - math.degrees(math.atan2(along[0, 1], along[0, 0]))
    place = Place(latitude, longitude, 0.0, bearing, height_above)
    if (outside := far_outside(crs, place)) is not None:
        _warn(f"{system}, {outside}")
    return place, (float(metres[0]), float(metres[1]))


def exactness_m(transformer: Any) -> float | None:
    """Return the error of a transformer's last operation, m; None if it ignores a difference of datums."""
    used = transformer.get_last_used_operation()
    return None if "ballpark" in used.description.lower() else float(max(used.accuracy, 0.0))


def far_outside(crs: Any, place: Place, tolerance_deg: float = 5.0) -> str | None:
    """Return a clause of a warning if a place is outside of a system's area of use; otherwise None.

    UTM zones are also used for their neighbours: hence the tolerance.
    """
    if crs.area_of_use is None:
        return None
    west, south, east, north = crs.area_of_use.bounds
    last = east if west <= east else east + 360.0  # it may cross the date line
    turns = [place.longitude_deg + turn for turn in (-360.0, 0.0, 360.0)]
    within = any(west - tolerance_deg <= turn <= last + tolerance_deg for turn in turns)
    if within and south - tolerance_deg <= place.latitude_deg <= north + tolerance_deg:
        return None
    return (
        f"which is for longitudes {west:g}° to {east:g}° and latitudes {south:g}° to {north:g}°, but its place is at "
        f"latitude {place.latitude_deg:.4f}°, longitude {place.longitude_deg:.4f}°: check its number and its "
        "coordinates"
    )


def _warn(text: str) -> None:
    warnings.warn(text, SarsplatWarning, stacklevel=4)
