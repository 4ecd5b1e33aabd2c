"""Georeference of exported files: map coordinates, UTM by default, or a sidecar file `FILE.place.json`."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import msgspec
import numpy as np
from jaxtyping import Float64, Real

from sarsplat.data import write_json
from sarsplat.data.files import open_file, plain_os_errors, read_versioned_json
from sarsplat.data.geotiff import LEVELS, far_outside
from sarsplat.data.header import PlaceHeader
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.extras import needed
from sarsplat.geometry import Place

Coordinates = Literal["scene", "map", "degrees"]
"""Coordinate system of a file."""

_STEP_M = 100.0  # step of the finite differences of the projection, short against the earth's radius, m
_STRETCHED = 0.01  # maximum scale error of a map without a note
_INEXACT_M = 0.5  # maximum error of the datum's transformation without a note, m
_CUT_M = 1e7  # minimum extent of a scene that is cut by the edge of a map of the earth, m
_MAX_ROUND_TRIP_M = 0.1
"""Maximum error of projection and inverse, m: ellipsoids that are not concentric leave millimetres."""
_HEIGHT_WKT = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)

_SCHEMA = "sarsplat-place"
_SCHEMA_VERSION = 1
_HEAD = 100  # bytes within which the schema is named
_ABOUT = (
    "Coordinates of the file are metres from the place, x towards the compass bearing x_towards_deg, y to the left of "
    "x, z up (a .glb file's root node turns z to y; its Gaussians have x, z and -y); (x, y, z, 1), multiplied by "
    "ecef_from_scene from the left, is the geocentric position, m, if height_m is above the ellipsoid."
)
_MAKE_ONE = (
    "import SICDs or CPHD, or a terrain with a coordinate system (`terrain`), or tell the dataset in Python with "
    "replace(dataset, place=sarsplat.Place(LATITUDE, LONGITUDE, HEIGHT)), and reconstruct that; of a file of Gaussians "
    "that was exported, keep FILE.place.json beside it"
)


@dataclass(frozen=True)
class MapSystem:
    """Projected coordinate system in metres, and the scene in it: east, north and height, in the datum of the place."""

    place: Place
    """Georeference of the scene."""
    crs: Any
    """System without heights, pyproj.CRS."""

    @classmethod
    def of(cls, place: Place, crs: str | None = None) -> Self:
        """Return the named system, such as "EPSG:32632"; by default UTM, or UPS beyond 84° north and 80° south.

        Raise SarsplatError if pyproj is not installed, or the system is unknown, not horizontal in metres, or cannot
        show the place; warn if that is outside the system's area of use.
        """
        with needed("gis", "a coordinate system"):
            import pyproj
        name, another = usual_system(place) if crs is None else crs, f"give another, such as {usual_system(place)}"
        try:
            found = pyproj.CRS.from_user_input(name)
        except pyproj.exceptions.CRSError as error:
            raise SarsplatError(f"`crs` {shown(name)} is not a known coordinate system; {another}") from error
        if not found.is_projected or [axis.unit_conversion_factor for axis in found.axis_info] != [1, 1]:
            raise SarsplatError(
                f"`crs` {name} ({found.name}) is not in metres on a plane, without heights, which are not converted; "
                f"{another}"
            )
        made = cls(place, found)
        points = _STEP_M * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
        projected = made.to_map(points)
        if not np.isfinite(projected).all() or not np.abs(made.to_scene(projected) - points).max() < _MAX_ROUND_TRIP_M:
            raise SarsplatError(
                f"`crs` {found.name} cannot show {place.latitude_deg:.4f}°, {place.longitude_deg:.4f}°; {another}"
            )
        if (outside := far_outside(found, place, 0.0)) is not None:
            warnings.warn(f"`crs` {name} ({found.name}), {outside}, or {another}", SarsplatWarning, stacklevel=4)
        return made

    @cached_property
    def _operation(self) -> Any:
        """Transformation from WGS 84 for the entire scene, the best with the installed data."""
        from pyproj.aoi import AreaOfInterest
        from pyproj.transformer import TransformerGroup

        latitude, longitude = self.place.latitude_deg, self.place.longitude_deg
        area: Any = AreaOfInterest(longitude, latitude, longitude, latitude)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of missing grids: `__str__` says how exact it is without
            operations = TransformerGroup("EPSG:4979", self.crs, always_xy=True, area_of_interest=area).transformers
        if not operations or "ballpark" in operations[0].description.lower():
            raise SarsplatError(
                f"`crs` {self.crs.name} has another datum than WGS 84, and nothing that is installed relates the two "
                f"at {latitude:.4f}°, {longitude:.4f}°: it may be some hundred metres away; give another, such as "
                f"{usual_system(self.place)}"
            )
        return operations[0]

    def to_map(self, points: Real[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return east, north and height, m, of points of the scene; infinite outside of the system."""
        latitude, longitude, height = self.place.to_geodetic(points).T
        east, north = self._operation.transform(longitude, latitude, height)[:2]
        known = np.stack([east, north])[:, np.isfinite(east) & np.isfinite(north)]
        if known.size and np.ptp(known, axis=1).max() > _CUT_M:
            raise SarsplatError(
                f"`crs` {self.crs.name} is cut in two within the scene, as along the date line, and would show parts "
                f"at both ends of the earth; give another, such as {usual_system(self.place)}"
            )
        return np.stack([east, north, height], axis=-1)

    def to_scene(self, places: Real[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return points of the scene, m, from east, north and height, m."""
        east, north, height = np.asarray(places, np.float64).T
        longitude, latitude = self._operation.transform(east, north, height, direction="INVERSE")[:2]
        return self.place.from_geodetic(np.stack([latitude, longitude, height], axis=-1))

    @cached_property
    def gradients(self) -> Float64[np.ndarray, "3 3"]:
        """Jacobian of (east, north, height) by the scene's axes at its origin, one row each."""
        ends = self.to_map(_STEP_M * np.concatenate([np.eye(3), -np.eye(3)]))
        return (ends[:3] - ends[3:]).T / (2 * _STEP_M)

    def turned(self, normals: Real[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return unit vectors of the scene in the axes east, north (of the map, not true north) and up."""
        left, _, right = np.linalg.svd(self.gradients)
        return np.asarray(normals, np.float64) @ (left @ right).T

    @property
    def wkt(self) -> str:
        """WKT 1 (OGC 01-009) of the system, with ellipsoidal heights if these refer to its ellipsoid."""
        ellipsoid = self.crs.ellipsoid
        is_wgs84 = ellipsoid.semi_major_metre == 6378137.0 and abs(ellipsoid.inverse_flattening - 298.2572) < 1e-3
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            horizontal: str = self.crs.to_wkt("WKT1_GDAL")
        if self.place.height_above != "ellipsoid" or not is_wgs84:
            return horizontal
        return f'COMPD_CS["{self.crs.name} + Ellipsoid (metre)",{horizontal},{_HEIGHT_WKT}]'

    def __str__(self) -> str:
        """Name, height datum, and unusual scale or accuracy, for the summary of an export."""
        height = LEVELS[self.place.height_above] + " (not the sea)" * (self.place.height_above == "ellipsoid")
        epsg = self.crs.to_epsg()
        number = "" if epsg is None else f" (EPSG:{epsg})"
        parts = [f"metres in {self.crs.name}{number}, heights above {height}"]
        scale = math.sqrt(abs(np.linalg.det(self.gradients[:2, :2])))
        if abs(scale - 1) > _STRETCHED:
            parts.append(f"a metre on the ground is {scale:.3g} m of the map here")
        accuracy = self._operation.accuracy
        if accuracy > _INEXACT_M:
            parts.append(f"reached from WGS 84 to {accuracy:g} m")
        elif accuracy < 0:
            parts.append("how exactly it is reached from WGS 84 is not known")
        return ", ".join(parts)


def usual_system(place: Place) -> str:
    """Return the UTM zone of a place, or UPS near the poles."""
    if place.latitude_deg > 84.0:
        return "EPSG:5041"  # UPS, east before north
    if place.latitude_deg < -80.0:
        return "EPSG:5042"
    zone = int((place.longitude_deg + 180) // 6) % 60 + 1
    return f"EPSG:{(32600 if place.latitude_deg >= 0 else 32700) + zone}"


class _PlaceFile(msgspec.Struct, frozen=True):
    """Content of a sidecar file."""

    place: PlaceHeader


def refuse_elsewhere(path: Path, coordinates: Coordinates, name: str, place: Place | None, crs: str | None) -> None:
    """Raise for a map's system if the file has other coordinates, and for map coordinates without georeference."""
    if crs is not None and coordinates != "map":
        what = "longitudes and latitudes" if coordinates == "degrees" else "the scene's own coordinates"
        raise SarsplatError(f"{path} will hold {what}; leave out `crs`, or export points to a .las or .laz file")
    if place is None and (crs is not None or coordinates == "degrees"):
        raise SarsplatError(f"{name} has no georeference; {_MAKE_ONE}")


def remove_place(path: Path) -> None:
    """Remove the sidecar of an earlier export; raise if another program wrote it."""
    beside = _beside(path)
    if not beside.exists():
        return
    with open_file(beside) as file:
        if _SCHEMA.encode() not in file.read(_HEAD):
            raise SarsplatError(f"{beside} exists and was not written by an export; choose another name")
    with plain_os_errors("remove", beside):
        beside.unlink()


def write_place(path: Path, place: Place) -> str:
    """Write the sidecar of a file, and return a description of it."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = place.axes.T, place.ecef
    beside = _beside(path)
    header = {"schema": _SCHEMA, "schema_version": _SCHEMA_VERSION, "file": path.name, "about": _ABOUT}
    write_json(beside, {**header, "place": place.as_dict(), "ecef_from_scene": matrix.tolist()})
    return f"{beside}: its georeference"


def read_place(path: Path) -> Place | None:
    """Return the georeference of a file from its sidecar, or None; raise if that cannot be read or is not ours."""
    beside = _beside(path)
    if not beside.exists():
        return None
    remedy = "export the file again, or take this one away"
    return read_versioned_json(beside, _PlaceFile, schema=_SCHEMA, version=_SCHEMA_VERSION, remedy=remedy).place.place


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.place.json")
