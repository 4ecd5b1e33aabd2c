"""From a scene's frame to the coordinates of maps: UTM where nothing else is asked for."""

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
"""Over which directions are compared; short against the earth."""
_STRETCHED = 0.01
_INEXACT_M = 0.5
_CUT_M = 1e7
"""No scene is so large, but the two ends of a map of the earth are farther apart."""
_ASTRAY_M = 0.1
"""Way there and back: ellipsoids that are not concentric leave millimetres."""
_HEIGHT_WKT = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


@dataclass(frozen=True)
class MapSystem:
    """A projected coordinate system in metres, and the scene in it: east, north and height.

    Heights are those of the place, above whatever that measures them from.

    Attributes
    ----------
    place : Place
        Where on earth the scene is.
    crs : pyproj.CRS
        The system, without heights.
    """

    place: Place
    crs: Any

    @classmethod
    def of(cls, place: Place, crs: str | None = None) -> Self:
        """The named system, such as "EPSG:32632"; unless given, UTM, or UPS beyond 84° north and 80° south.

        Raises
        ------
        SarsplatError
            If pyproj is not installed, there is no such system, it is not one of horizontal metres, or it cannot show
            the place.

        Warns
        -----
        SarsplatWarning
            If the place is outside the area that the system is for.
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
                f"--crs {name} ({found.name}) has heights of its own, and heights are not converted; give the "
                f"horizontal system alone, such as {usual_system(place)}"
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
        """Refuse a system that cannot show the place there and back."""
        points = _STEP_M * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
        there = self.to_map(points)
        if not np.isfinite(there).all() or not np.abs(self.to_scene(there) - points).max() < _ASTRAY_M:
            raise SarsplatError(
                f"--crs {self.crs.name} cannot show {self.place.latitude_deg:.4f}°, {self.place.longitude_deg:.4f}°; "
                f"give another, such as {usual_system(self.place)}"
            )

    @property
    def epsg(self) -> int | None:
        """Its number, if it has one."""
        number: int | None = self.crs.to_epsg()
        return number

    @cached_property
    def _operation(self) -> Any:
        """Between WGS 84 and the system: one for the whole scene, the best that the installed data allow."""
        from pyproj.aoi import AreaOfInterest
        from pyproj.transformer import TransformerGroup

        latitude, longitude = self.place.latitude_deg, self.place.longitude_deg
        here: Any = AreaOfInterest(longitude, latitude, longitude, latitude)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of missing grids: `__str__` says how exact it is without
            operations = TransformerGroup("EPSG:4979", self.crs, always_xy=True, area_of_interest=here).transformers
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
        """East, north and height, m, of points of the scene; infinite where the system has none."""
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
        """Points of the scene, m, at an east, a north and a height, m."""
        east, north, height = np.asarray(places, np.float64).T
        longitude, latitude = self._operation.transform(east, north, height, direction="INVERSE")[:2]
        return self.place.from_geodetic(np.stack([latitude, longitude, height], axis=-1))

    @cached_property
    def gradients(self) -> Float64[np.ndarray, "3 3"]:
        """How east, north and height grow along the scene's axes at its origin: one row each."""
        ends = self.to_map(_STEP_M * np.concatenate([np.eye(3), -np.eye(3)]))
        return (ends[:3] - ends[3:]).T / (2 * _STEP_M)

    def turned(self, normals: Real[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors of the scene along east, north and up of the map, whose north may not be the true one."""
        left, _, right = np.linalg.svd(self.gradients)
        return np.asarray(normals, np.float64) @ (left @ right).T

    @property
    def wkt(self) -> str:
        """The system as WKT of version 1 (OGC 01-009), with ellipsoidal heights where these are above its ellipsoid."""
        ellipsoid = self.crs.ellipsoid
        alike = ellipsoid.semi_major_metre == 6378137.0 and abs(ellipsoid.inverse_flattening - 298.2572) < 1e-3
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            horizontal: str = self.crs.to_wkt("WKT1_GDAL")
        if self.place.height_above != "ellipsoid" or not alike:
            return horizontal
        return f'COMPD_CS["{self.crs.name} + Ellipsoid (metre)",{horizontal},{_HEIGHT_WKT}]'

    def __str__(self) -> str:
        """Its name, what its heights are, and what is not as usual: said with every export."""
        height = LEVELS[self.place.height_above] + " (not the sea)" * (self.place.height_above == "ellipsoid")
        number = "" if self.epsg is None else f" (EPSG:{self.epsg})"
        said = [f"metres in {self.crs.name}{number}, heights above {height}"]
        scale = math.sqrt(abs(np.linalg.det(self.gradients[:2, :2])))
        if abs(scale - 1) > _STRETCHED:
            said.append(f"a metre on the ground is {scale:.3g} m of the map here")
        accuracy = self._operation.accuracy
        if accuracy > _INEXACT_M:
            said.append(f"reached from WGS 84 to {accuracy:g} m")
        elif accuracy < 0:
            said.append("how exactly it is reached from WGS 84 is not known")
        return ", ".join(said)


def usual_system(place: Place) -> str:
    """The UTM zone of a place; UPS near the poles, where there is none."""
    low, high = _UTM_ENDS_DEG
    if not low <= place.latitude_deg <= high:
        return _POLAR["N" if place.latitude_deg > 0 else "S"]
    zone = int((place.longitude_deg + 180) // 6) % 60 + 1
    return f"EPSG:{(32600 if place.latitude_deg >= 0 else 32700) + zone}"
