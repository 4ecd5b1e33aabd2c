"""Where on earth the middle of a map is, by its number in EPSG's list."""

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
"""Over which the axes of a map are compared with east and north."""
_SKEWED = 1e-3
_BEYOND_DEG = 5.0
"""Of the area that a system is for, beyond which it may be another one; zones are used for their neighbours."""


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
    crs: Any, at: tuple[float, float], name: str, height_above: HeightAbove = "unknown"
) -> MapPlace | None:
    """Where a point (x, y) of a projected system of EPSG is; None, with a warning, if that cannot be said of `name`."""
    from pyproj import Transformer

    system = f"{name} lies on a map (EPSG:{crs.to_epsg()}), but where on earth that is stays unknown:"
    steps = _STEP_M * np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    transformer: Any = Transformer.from_crs(crs, "EPSG:4978", always_xy=True)
    corners = np.transpose(transformer.transform(*(np.asarray(at) + steps).T, np.zeros(len(steps))))
    if (exact_m := exactness_m(transformer)) is None:
        _warn(f"{system} {NOT_RELATED}")
        return None
    if exact_m > INEXACT_M:
        _warn(f"{name} lies on a map (EPSG:{crs.to_epsg()}), from where WGS 84 is reached to {exact_m:g} m")
    if not np.isfinite(corners).all():
        _warn(f"{system} ({at[0]:.10g}, {at[1]:.10g}) is nowhere in that system")
        return None
    found = _seen_around(corners, system, height_above)
    if found is not None and (outside := far_outside(crs, found.place)) is not None:
        _warn(f"{name} lies on a map (EPSG:{crs.to_epsg()}), {outside}")
    return found


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


INEXACT_M = 1.0
"""Beyond it is said how exactly WGS 84 is reached; ETRS89 and the like are nearer."""
NOT_RELATED = (
    "nothing that is installed relates its datum to WGS 84, from which it may be some hundred metres away; bring it "
    "into WGS 84, as by gdalwarp -t_srs EPSG:326xx (the UTM zone)"
)


def exactness_m(transformer: Any) -> float | None:
    """How exact the way is that a transformer went last, m; None if it ignores that two datums are different."""
    used = transformer.get_last_used_operation()
    return None if "ballpark" in used.description.lower() else float(max(used.accuracy, 0.0))


def far_outside(crs: Any, place: Place) -> str | None:
    """Where a system is for, if a place is so far from there that its number or its coordinates may be others'."""
    area = crs.area_of_use
    if area is None or is_within(area.bounds, place, _BEYOND_DEG):
        return None
    west, south, east, north = area.bounds
    return (
        f"which is for longitudes {west:g}° to {east:g}° and latitudes {south:g}° to {north:g}°, but at latitude "
        f"{place.latitude_deg:.4f}°, longitude {place.longitude_deg:.4f}°: check its number and its coordinates"
    )


def is_within(bounds_deg: tuple[float, float, float, float], place: Place, more_deg: float = 0.0) -> bool:
    """Whether a place lies between west, south, east and north; an area may lie across the date line."""
    west, south, east, north = bounds_deg
    turns = [place.longitude_deg + turn for turn in (-360.0, 0.0, 360.0)]
    east = east if west <= east else east + 360.0
    within = any(west - more_deg <= turn <= east + more_deg for turn in turns)
    return within and south - more_deg <= place.latitude_deg <= north + more_deg


def _warn(text: str) -> None:
    warnings.warn(text, SarsplatWarning, stacklevel=4)


UNCONVERTED = (
    "heights are not converted: from one level to another they can be up to about 100 m apart, and gdalwarp -s_srs "
    "EPSG:326xx+5773 (of EGM96; +3855 of EGM2008, +5703 of NAVD88) -t_srs EPSG:4979, and then -s_srs EPSG:4326 -t_srs "
    "EPSG:326xx, makes ellipsoidal ones of them"
)
