"""Projection from a scene's frame to map coordinates, UTM by default."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Float64, Real

from sarsplat.data.geotiff import LEVELS
from sarsplat.data.map_place import is_within
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.extras import install_command
from sarsplat.geometry import Place

_POLAR = {"N": "EPSG:5041", "S": "EPSG:5042"}  # UPS, east before north
_UTM_ENDS_DEG = (-80.0, 84.0)
_STEP_M = 100.0
"""Step of the finite differences of the projection, short against the earth's radius, m."""
_STRETCHED = 0.01
"""Maximum scale error of a map without a note."""
_INEXACT_M = 0.5
"""Maximum error of the datum's transformation without a note, m."""
_CUT_M = 1e7
"""Minimum extent of a scene that is cut by the edge of a map of the earth, m."""
_MAX_ROUND_TRIP_M = 0.1
"""Maximum error of projection and inverse, m: ellipsoids that are not concentric leave millimetres."""
_HEIGHT_WKT = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


@dataclass(frozen=True)
class MapSystem:
    """Projected coordinate system in metres, and the scene in it: east, north and height.

    Heights have the datum of the place.

    Attributes
    ----------
    place : Place
        Georeference of the scene.
    crs : pyproj.CRS
        System without heights.
    """

    place: Place
    crs: Any

    @classmethod
    def of(cls, place: Place, crs: str | None = None) -> Self:
        """Return the named system, such as "EPSG:32632"; by default UTM, or UPS beyond 84° north and 80° south.

        Raises
        ------
        SarsplatError
            If pyproj is not installed, or the system is unknown, not horizontal in metres, or cannot show the place.

        Warns
        -----
        SarsplatWarning
            If the place is outside the system's area of use.
        """
        try:
            import pyproj
        except ImportError as error:
            raise SarsplatError(
                f"coordinates of maps need pyproj, which is not installed; {install_command('gis')}"
            ) from error
        name = usual_system(place) if crs is None else crs
        try:
            found = pyproj.CRS.from_user_input(name)
        except pyproj.exceptions.CRSError as error:
            raise SarsplatError(
                f"--crs {shown(name)} is not a known coordinate system; give one as EPSG:NUMBER, such as "
                f"{usual_system(place)}"
            ) from error
        if found.is_compound or len(found.axis_info) > 2:
            raise SarsplatError(
                f"--crs {name} ({found.name}) includes heights, which are not converted; give the horizontal "
                f"system alone, such as {usual_system(place)}"
            )
        if not found.is_projected or any(axis.unit_conversion_factor != 1 for axis in found.axis_info):
            raise SarsplatError(
                f"--crs {name} ({found.name}) is not in metres on a plane; give a projected one, such as "
                f"{usual_system(place)}"
            )
        made = cls(place, found)
        made._check()
        if (area := found.area_of_use) is not None and not is_within(area.bounds, place):
            west, south, east, north = area.bounds
            warnings.warn(
                f"--crs {name} ({found.name}) is for longitudes {west:g}° to {east:g}° and latitudes {south:g}° to "
                f"{north:g}°, and the place is at latitude {place.latitude_deg:.4f}°, longitude "
                f"{place.longitude_deg:.4f}°, where it may be far from true to scale or unknown to other programs; "
                f"give another, such as {usual_system(place)}",
                SarsplatWarning,
                stacklevel=4,
            )
        return made

    def _check(self) -> None:
        """Raise if the projection and its inverse do not reproduce the place."""
        points = _STEP_M * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
        projected = self.to_map(points)
        if not np.isfinite(projected).all() or not np.abs(self.to_scene(projected) - points).max() < _MAX_ROUND_TRIP_M:
            raise SarsplatError(
                f"--crs {self.crs.name} cannot show {self.place.latitude_deg:.4f}°, {self.place.longitude_deg:.4f}°; "
                f"give another, such as {usual_system(self.place)}"
            )

    @property
    def epsg(self) -> int | None:
        """EPSG number, or None."""
        number: int | None = self.crs.to_epsg()
        return number

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
        if not operations:
            raise SarsplatError(f"--crs {self.crs.name} cannot be reached from WGS 84; give another")
        if "ballpark" in operations[0].description.lower():
            raise SarsplatError(
                f"--crs {self.crs.name} has another datum than WGS 84, and nothing that is installed relates the two "
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
                f"--crs {self.crs.name} is cut in two within the scene, as along the date line, and would show parts "
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
        number = "" if self.epsg is None else f" (EPSG:{self.epsg})"
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
    low, high = _UTM_ENDS_DEG
    if not low <= place.latitude_deg <= high:
        return _POLAR["N" if place.latitude_deg > 0 else "S"]
    zone = int((place.longitude_deg + 180) // 6) % 60 + 1
    return f"EPSG:{(32600 if place.latitude_deg >= 0 else 32700) + zone}"
