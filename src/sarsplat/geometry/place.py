"""Georeference of a scene: its origin in WGS 84, and the bearing of its x axis."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from jaxtyping import Float64
from jaxtyping import Real as RealArray

from sarsplat.arguments import checks_arguments, described, expect, is_number
from sarsplat.errors import SarsplatError, shown

DATUM = "WGS 84"
"""Datum of all latitudes, longitudes and geocentric coordinates."""

HeightAbove = Literal["ellipsoid", "sea level", "unknown"]

_EQUATOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_2 = 2 * _FLATTENING - _FLATTENING**2
_ROUNDS = 3  # iterations of Bowring's formula: latitudes to 10⁻¹⁵ rad up to 10,000 km above ground
_LIMITS = {"latitude_deg": 90.0, "longitude_deg": 360.0, "height_m": 1e5, "x_towards_deg": sys.float_info.max}


@dataclass(frozen=True)
class Place:
    """Georeference (WGS 84) of a scene: the place of its origin and the directions of its axes.

    The scene's z points away from the ellipsoid at the origin and its x to the compass bearing `x_towards_deg`, so the
    compass bearing of a radar is its azimuth plus this. The frame is flat: 1 km from the origin, the curved earth
    is 8 cm below z = 0. Conversions are exact, for points in metres in the scene's world frame.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
        Origin, degrees, north and east positive; longitudes are wrapped to ±180°.
    height_m : float
        Height of the origin, m, above the level that `height_above` names.
    x_towards_deg : float
        Compass bearing of the scene's x axis, degrees clockwise from true north; 90 is east. At a pole, where every
        direction is north or south, north is that of the meridian `longitude_deg`.
    height_above : {"ellipsoid", "sea level", "unknown"}
        Vertical datum. Heights above sea level differ by up to 110 m, and are used as if above the ellipsoid, which
        moves places 1 km away by less than 2 cm sideways.

    Raises
    ------
    SarsplatError
        If a value is not a number, or out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    x_towards_deg: float = 90.0
    height_above: HeightAbove = "ellipsoid"

    def __post_init__(self) -> None:
        for name, limit in _LIMITS.items():
            value = getattr(self, name)
            if not is_number(value) or not abs(value) <= limit:  # also catches NaN
                raise SarsplatError(
                    f"{name} {described(value)} of a place on earth is not a number between ±{limit:g}; give latitude "
                    "before longitude, and bearing, in degrees; height in metres"
                )
            object.__setattr__(self, name, float(value))  # JSON cannot hold numpy's numbers
        expect(HeightAbove, height_above=self.height_above)
        object.__setattr__(self, "longitude_deg", math.remainder(self.longitude_deg, 360.0))
        object.__setattr__(self, "x_towards_deg", self.x_towards_deg % 360.0)

    def __str__(self) -> str:
        above = {"ellipsoid": "the ellipsoid", "unknown": "an unknown level"}.get(self.height_above, self.height_above)
        latitude = f"{abs(self.latitude_deg):.6f}° {'S' if self.latitude_deg < 0 else 'N'}"
        longitude = f"{abs(self.longitude_deg):.6f}° {'W' if self.longitude_deg < 0 else 'E'}"
        return (
            f"{latitude}, {longitude} ({DATUM}), {self.height_m:.1f} m above {above}, x towards {self.x_towards_deg:g}°"
        )

    @classmethod
    def of_ecef(cls, origin: RealArray[np.ndarray, " 3"], x_towards_deg: float = 90.0) -> Self:
        """Make the place whose origin has these geocentric coordinates, m."""
        latitude, longitude, height = map(
            float, geodetic_of_ecef(direction_of(origin, "place in geocentric coordinates"))
        )
        return cls(latitude, longitude, height, x_towards_deg)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields and the datum, for JSON."""
        return {field.name: getattr(self, field.name) for field in fields(self)} | {"datum": DATUM}

    @cached_property
    def ecef(self) -> Float64[np.ndarray, " 3"]:
        """Origin in geocentric coordinates (ECEF), m."""
        return ecef_of_geodetic(np.array([self.latitude_deg, self.longitude_deg, self.height_m]))

    @cached_property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Rows: the world's x, y and z in geocentric coordinates."""
        latitude, longitude, bearing = np.deg2rad([self.latitude_deg, self.longitude_deg, self.x_towards_deg])
        east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        north = np.array(
            [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)]
        )
        up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
        x = math.sin(bearing) * east + math.cos(bearing) * north
        return np.array([x, np.cross(up, x), up])

    def to_ecef(self, points: RealArray[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Convert points of the scene to geocentric coordinates, m."""
        return self.ecef + places_of(points, "points of the scene") @ self.axes

    def from_ecef(self, places: RealArray[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Convert geocentric coordinates to points of the scene, m."""
        return (places_of(places, "geocentric coordinates") - self.ecef) @ self.axes.T

    def to_geodetic(self, points: RealArray[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Convert points of the scene to latitude and longitude, degrees, and height, m."""
        return geodetic_of_ecef(self.to_ecef(points))

    def from_geodetic(self, places: RealArray[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Convert latitude and longitude, degrees, and height, m, to points of the scene, m."""
        return self.from_ecef(ecef_of_geodetic(places_of(places, "latitudes, longitudes and heights")))

    def moved(self, by: RealArray[np.ndarray, " 3"]) -> Self:
        """Return the place of a scene whose origin is at a point of this one, m, with the same direction of x.

        Its z points away from the ellipsoid at its own origin: 1 km away it is tilted by 0.16 mrad.
        """
        place = self.of_ecef(self.to_ecef(by), 0.0)
        north, west, _ = place.axes @ self.axes[0]
        bearing = math.degrees(math.atan2(-west, north))
        return replace(place, x_towards_deg=bearing, height_above=self.height_above)

    @checks_arguments
    def bearing_deg(self, azimuth_deg: float) -> float:
        """Convert a view's azimuth to a compass bearing, 0 to 360°."""
        return (azimuth_deg + self.x_towards_deg) % 360.0


def ecef_of_geodetic(places: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Convert latitude and longitude, degrees, and height above the ellipsoid, m, to geocentric coordinates, m."""
    latitude, longitude, height = np.deg2rad(places[..., 0]), np.deg2rad(places[..., 1]), places[..., 2]
    normal = _EQUATOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(latitude) * np.sin(latitude))
    return np.stack(
        [
            (normal + height) * np.cos(latitude) * np.cos(longitude),
            (normal + height) * np.cos(latitude) * np.sin(longitude),
            (normal + height - _ECCENTRICITY_2 * normal) * np.sin(latitude),
        ],
        axis=-1,
    )


def geodetic_of_ecef(places: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Convert geocentric coordinates, m, to latitude and longitude, degrees, and height above the ellipsoid, m.

    Source: Bowring, Survey Review 23 (181), 1976.
    """
    x, y, z = np.moveaxis(places, -1, 0)
    polar = _EQUATOR_M * (1 - _FLATTENING)
    second = _ECCENTRICITY_2 / (1 - _ECCENTRICITY_2)
    across = np.hypot(x, y)
    reduced = np.arctan2(z, (1 - _FLATTENING) * across)
    for _ in range(_ROUNDS):
        latitude = np.arctan2(
            z + second * polar * np.sin(reduced) ** 3, across - _ECCENTRICITY_2 * _EQUATOR_M * np.cos(reduced) ** 3
        )
        reduced = np.arctan2((1 - _FLATTENING) * np.sin(latitude), np.cos(latitude))
    sine, cosine = np.sin(latitude), np.cos(latitude)
    height = across * cosine + z * sine - _EQUATOR_M * np.sqrt(1 - _ECCENTRICITY_2 * sine**2)
    return np.stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), height], axis=-1)


def direction_of(value: object, what: str) -> Float64[np.ndarray, " 3"]:
    """Return a direction as float64 [3], finite and not zero; `what` names it in errors."""
    vector = _numbers(value)
    if vector is None or vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        plain = value.tolist() if isinstance(value, np.ndarray) else value
        raise SarsplatError(f"the {what} {shown(plain)} has no direction; give three numbers, not all 0")
    return vector


def places_of(value: object, what: str) -> Float64[np.ndarray, "*n 3"]:
    """Return points as float64 [..., 3]; `what` names them in errors."""
    places = _numbers(value)
    if places is None or places.shape[-1:] != (3,):
        plain = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else shown(value)
        raise SarsplatError(f"the {what} are {plain}; give an array of numbers whose last axis has three")
    return places


def unit_of(vector: Float64[np.ndarray, " 3"] | Sequence[float | int]) -> Float64[np.ndarray, " 3"]:
    """Return the vector of length 1 along one of any length: no square overflows."""
    scaled = np.asarray(vector, float) / np.abs(vector).max()
    return scaled / np.linalg.norm(scaled)


def _numbers(value: object) -> Float64[np.ndarray, "*shape"] | None:
    """Return real numbers as float64, or None for anything else, such as text."""
    try:
        array = np.asarray(value)
        return None if array.dtype.kind not in "iufO" else array.astype(np.float64)
    except (TypeError, ValueError):
        return None
