"""Where on earth the middle of a map is, by its number in EPSG's list."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatWarning
from sarsplat.extras import install_command
from sarsplat.geometry import Place
from sarsplat.geometry.place import HeightAbove, geodetic_of_ecef

_STEP_M = 50.0
"""Over which the axes of a map are compared with east and north."""
_SKEWED = 1e-3


@dataclass(frozen=True)
class MapPlace:
    """A point of a map on earth, at height 0, and how long a unit of the map is there.

    Attributes
    ----------
    place : Place
        Its x axis is that of the map.
    metres : (float, float)
        On the ground, for each unit of the map along its x and y.
    """

    place: Place
    metres: tuple[float, float]


def place_on_map(
    epsg: int, at: tuple[float, float], name: str, height_above: HeightAbove = "unknown"
) -> MapPlace | None:
    """Where a point (x, y) of a projected system is; None, with a warning, if that cannot be said of `name`."""
    system = f"{name} lies on a map (EPSG:{epsg}), but where on earth that is stays unknown:"
    try:
        from pyproj import Transformer
        from pyproj.exceptions import ProjError
    except ImportError:
        _warn(f"{system} pyproj is not installed; {install_command('gis')}")
        return None
    steps = _STEP_M * np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    try:
        transformer: Any = Transformer.from_crs(f"EPSG:{epsg}", "EPSG:4978", always_xy=True)
        corners = np.transpose(transformer.transform(*(np.asarray(at) + steps).T, np.zeros(len(steps))))
    except ProjError as error:
        _warn(f"{system} pyproj does not know that system ({error})")
        return None
    if not np.isfinite(corners).all():
        _warn(f"{system} ({at[0]:.10g}, {at[1]:.10g}) is nowhere in that system")
        return None
    return _seen_around(corners, system, height_above)


def _seen_around(corners: Float64[np.ndarray, "5 3"], system: str, height_above: HeightAbove) -> MapPlace | None:
    """The same, of the geocentric coordinates of the point and of four around it."""
    latitude, longitude, _ = map(float, geodetic_of_ecef(corners[0]))
    level = Place(latitude, longitude, 0.0)  # x to the east
    along = (level.from_ecef(corners)[1:3, :2] - level.from_ecef(corners)[3:5, :2]) / (2 * _STEP_M)
    metres = np.linalg.norm(along, axis=1)
    if not abs(along[0] @ along[1]) < _SKEWED * math.prod(metres) or not np.linalg.det(along) > 0:
        _warn(f"{system} its axes are not at right angles there; warp it to a UTM zone")
        return None
    bearing = 90.0 - math.degrees(math.atan2(along[0, 1], along[0, 0]))
    place = Place(latitude, longitude, 0.0, bearing, height_above)
    return MapPlace(place, (float(metres[0]), float(metres[1])))


def _warn(text: str) -> None:
    warnings.warn(text, SarsplatWarning, stacklevel=4)


ELLIPSOIDAL = (4979, 4937, 5019, 5030)
"""Codes of vertical systems whose heights are above the ellipsoid: WGS 84, ETRS89 or GRS 1980."""


def height_above_of(code: Any) -> HeightAbove:
    """What heights are measured from, by the code of a GeoTIFF's vertical system, or None."""
    if not isinstance(code, int) or not 0 < code < 32767:
        return "unknown"
    return "ellipsoid" if code in ELLIPSOIDAL else "sea level"
