"""Conversion of a map point in a projected EPSG system to a place on earth."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatWarning
from sarsplat.geometry import Place
from sarsplat.geometry.place import HeightAbove, geodetic_of_ecef

_STEP_M = 50.0
"""Distance over which a map's axes are compared with east and north."""
_SKEWED = 1e-3
"""Maximum cosine of the angle between a map's axes on the ground."""
_BEYOND_DEG = 5.0
"""Tolerance around a system's area of use: UTM zones are also used for their neighbours."""


@dataclass(frozen=True)
class MapPlace:
    """A point of a map on earth, at height 0, and the map's scale.

    Attributes
    ----------
    place : Place
        Its x axis is the map's.
    metres : (float, float)
        Metres on the ground for each unit of the map along its x and y.
    """

    place: Place
    metres: tuple[float, float]


def place_on_map(
    crs: Any, at: tuple[float, float], name: str, height_above: HeightAbove = "unknown"
) -> MapPlace | None:
    """Locate a point (x, y) of a projected EPSG system on earth; None, with a warning about `name`, if that fails."""
    from pyproj import Transformer

    system = f"{name} has map coordinates (EPSG:{crs.to_epsg()}), but its place on earth stays unknown:"
    steps = _STEP_M * np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    transformer: Any = Transformer.from_crs(crs, "EPSG:4978", always_xy=True)
    corners = np.transpose(transformer.transform(*(np.asarray(at) + steps).T, np.zeros(len(steps))))
    if (exact_m := exactness_m(transformer)) is None:
        _warn(f"{system} {NOT_RELATED}")
        return None
    if exact_m > INEXACT_M:
        _warn(f"{name} has map coordinates (EPSG:{crs.to_epsg()}) that convert to WGS 84 to within {exact_m:g} m")
    if not np.isfinite(corners).all():
        _warn(f"{system} ({at[0]:.10g}, {at[1]:.10g}) is outside of that system")
        return None
    found = _from_geocentric(corners, system, height_above)
    if found is not None and (outside := far_outside(crs, found.place)) is not None:
        _warn(f"{name} has map coordinates (EPSG:{crs.to_epsg()}), {outside}")
    return found


def _from_geocentric(corners: Float64[np.ndarray, "5 3"], system: str, height_above: HeightAbove) -> MapPlace | None:
    """Make a `MapPlace` from geocentric coordinates of the point and of points `_STEP_M` to +x, +y, −x and −y."""
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


INEXACT_M = 1.0
"""Minimum error of a conversion to WGS 84 that is reported; ETRS89 and its like are more exact."""
NOT_RELATED = (
    "no installed transformation relates its datum to WGS 84, and they can differ by some hundred metres; convert it "
    "to WGS 84, as by gdalwarp -t_srs EPSG:326xx (the UTM zone)"
)


def exactness_m(transformer: Any) -> float | None:
    """Return the error of a transformer's last operation, m; None if it ignores a difference of datums."""
    used = transformer.get_last_used_operation()
    return None if "ballpark" in used.description.lower() else float(max(used.accuracy, 0.0))


def far_outside(crs: Any, place: Place) -> str | None:
    """Return a clause of a warning if a place is far outside of a system's area of use; otherwise None."""
    area = crs.area_of_use
    if area is None or is_within(area.bounds, place, _BEYOND_DEG):
        return None
    west, south, east, north = area.bounds
    return (
        f"which is for longitudes {west:g}° to {east:g}° and latitudes {south:g}° to {north:g}°, but at latitude "
        f"{place.latitude_deg:.4f}°, longitude {place.longitude_deg:.4f}°: check its number and its coordinates"
    )


def is_within(bounds_deg: tuple[float, float, float, float], place: Place, more_deg: float = 0.0) -> bool:
    """Return True if a place lies within (west, south, east, north), which may cross the date line."""
    west, south, east, north = bounds_deg
    turns = [place.longitude_deg + turn for turn in (-360.0, 0.0, 360.0)]
    east = east if west <= east else east + 360.0
    within = any(west - more_deg <= turn <= east + more_deg for turn in turns)
    return within and south - more_deg <= place.latitude_deg <= north + more_deg


def _warn(text: str) -> None:
    warnings.warn(text, SarsplatWarning, stacklevel=4)


UNCONVERTED = (
    "heights are not converted: levels can differ by about 100 m, and gdalwarp -s_srs EPSG:326xx+5773 (EGM96; +3855 "
    "EGM2008, +5703 NAVD88) -t_srs EPSG:4979, then -s_srs EPSG:4326 -t_srs EPSG:326xx, makes them ellipsoidal"
)
"""Sentence about heights above sea level."""
