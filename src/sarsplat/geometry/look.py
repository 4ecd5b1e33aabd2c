"""Geometry of a view: places in the image, rays, and the ground."""

import math
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from jaxtyping import Float64

Lengths = TypeVar("Lengths", bound=Any)
"""Type of lengths, m: number, array or tensor."""

Power = TypeVar("Power", bound=Any)
"""Type of linear power: number, array or tensor."""

Ends = tuple[float, float]
"""Lower and upper bound, m."""


@dataclass(frozen=True, eq=False)
class Look:
    """Geometry of a far-away radar that looks at the scene, computed from the angles of a view.

    A place x_w of the world is x_r = R_r x_w in the radar frame: the image shows it at its azimuth and range, and the
    ray through it is at its azimuth and elevation. Ground is level, at z = 0 unless a height is given; θ is the grazing
    angle, and τ the tilt.

    Parameters
    ----------
    frame : numpy.ndarray, float64 [3, 3]
        R_r, from the world. Rows, perpendicular to each other and of length 1: azimuth (direction of flight), elevation
        (⟂ to the line of sight, upwards), range (away from the radar). A rotation if the radar looks to the right, and
        its mirror image if it looks to the left.
    slope : float
        tan θ / cos τ: elevation for each metre of slant range on the ground, and so β⁰ over γ⁰ of the ground.
    lean : float
        tan τ: rise of the azimuth axis for each metre that the elevation axis rises.
    stretch : float
        Azimuth in the image for each metre of azimuth in the frame: 1 unless the cross-range
        of a target aloft is scaled.
    """

    frame: Float64[np.ndarray, "3 3"]
    slope: float
    lean: float
    stretch: float = 1.0

    @classmethod
    def of(
        cls, azimuth_deg: float, grazing_deg: float, tilt_deg: float = 0.0, left: bool = False, stretch: float = 1.0
    ) -> Self:
        """Compute it from a view's angles; source: SAR-GS, eq. (5), for level azimuth and a right-looking radar."""
        phi, theta, tau = math.radians(azimuth_deg), math.radians(grazing_deg), math.radians(tilt_deg)
        sp, cp, st, ct = math.sin(phi), math.cos(phi), math.sin(theta), math.cos(theta)
        frame = np.array([[-sp, -cp, 0.0], [-st * cp, st * sp, ct], [-ct * cp, ct * sp, -st]])
        if left:
            frame[0] = -frame[0]
        if tau:
            cos, sin = math.cos(tau), math.sin(tau)
            frame[:2] = np.array([[cos, sin], [-sin, cos]]) @ frame[:2]
        return cls(frame, math.tan(theta) / math.cos(tau), math.tan(tau), stretch)

    # ---- images ------------------------------------------------------------------------------------------------------
    @property
    def facing(self) -> Float64[np.ndarray, " 3"]:
        """Unit vector from the scene to the radar, world frame."""
        return -self.frame[2]

    @property
    def gradients(self) -> Float64[np.ndarray, "2 3"]:
        """Gradients of azimuth (row 0) and slant range (row 1) in the image along x, y and z."""
        return self.frame[[0, 2]] * np.array([[self.stretch], [1.0]])

    def in_frame(self, azimuth: Lengths, slant_range: Lengths) -> tuple[Lengths, Lengths]:
        """Convert azimuth and slant range in the image to those in the radar frame, m."""
        return azimuth / self.stretch, slant_range

    @property
    def sine(self) -> float:
        """Sin θ: decrease of slant range for each metre of height, and cosine of the ground's incidence angle."""
        return float(-self.frame[2, 2])

    @property
    def height_per_elevation(self) -> float:
        """Cos θ cos τ: height for each metre of elevation, at fixed azimuth and slant range."""
        return float(self.frame[1, 2])

    @property
    def height_per_azimuth(self) -> float:
        """Cos θ sin τ: height for each metre of azimuth, at fixed elevation and slant range."""
        return float(self.frame[0, 2])

    @property
    def level(self) -> bool:
        """True if the azimuth axis is level: then rays and pixels on level ground are both in rows."""
        return self.lean == 0

    # ---- places on the ground ----------------------------------------------------------------------------------------
    @property
    def ahead(self) -> Float64[np.ndarray, " 2"]:
        """Level unit vector (x, y) away from the radar: direction of ground range and of shadows."""
        return self.frame[2, :2] / self._cosine

    @property
    def onto_ground(self) -> Float64[np.ndarray, "2 2"]:
        """Displacement (x, y) on the ground for each metre of azimuth (row 0) and of slant range (row 1)."""
        across, away = self._across, self.frame[2, :2] / self._cosine**2
        if self.level:
            return np.stack([across, away])
        return np.stack([across / self._cos_tilt, away - self.lean * self.sine / self._cosine * across])

    @property
    def displaced(self) -> Float64[np.ndarray, " 2"]:
        """Layover: displacement (x, y) in the image for each metre of height, towards the radar if level."""
        towards = self.frame[2, :2] * self.frame[2, 2] / (1 - self.frame[2, 2] ** 2)
        return towards if self.level else towards + self.lean / self._cosine * self._across

    def disc_m(self, half_azimuth_m: float, half_range_m: float) -> float:
        """Return the radius, m, of the largest disc of ground within these distances from the image's centre."""
        across = half_azimuth_m / math.sqrt(1 - float(self.frame[0, 2]) ** 2)
        return min(across, self.ground_range(half_range_m))

    def ground_range(self, slant_range: Lengths, height: Any = 0.0) -> Lengths:
        """Convert slant range to ground range, the distance from the origin along `ahead`, m."""
        return (slant_range + height * self.sine) / self._cosine

    def slant_range(self, ground_range: Lengths, height: Any = 0.0) -> Lengths:
        """Convert ground range, the distance from the origin along `ahead`, to slant range, m."""
        return ground_range * self._cosine - height * self.sine

    def to_ground(self, azimuth: Lengths, slant_range: Lengths) -> tuple[Lengths, Lengths]:
        """Convert a place in the image to the ground, m: across (flight of a right-looking radar) and `ahead`."""
        ahead = self.ground_range(slant_range)
        level = azimuth if self.level else azimuth / self._cos_tilt - ahead * (self.lean * self.sine)
        return (level if self._along_right > 0 else -level), ahead

    def to_image(self, across: Lengths, ahead: Lengths) -> tuple[Lengths, Lengths]:
        """Convert a place on the ground, across and `ahead`, to azimuth and slant range in the image, m."""
        level = across if self._along_right > 0 else -across
        if not self.level:
            level = self._cos_tilt * (level + ahead * (self.lean * self.sine))
        return level, self.slant_range(ahead)

    def shadow_m(self, height: Lengths) -> Lengths:
        """Return the length of the shadow of an object of this height on the ground, m."""
        return height / (self.slope * self._cos_tilt)

    def corner_m(self, azimuth_m: float, slant_range_m: float) -> float:
        """Return the largest distance from the origin, m, of ground shown at ± these distances from the centre."""
        if self.level:
            return math.hypot(azimuth_m, self.ground_range(slant_range_m))
        across, away = self.onto_ground * np.array([[azimuth_m], [slant_range_m]])
        return max(math.hypot(*(across + away)), math.hypot(*(across - away)))

    # ---- rays and the ground -----------------------------------------------------------------------------------------
    def elevation_on_ground(self, azimuth: Any, slant_range: Lengths) -> Lengths:
        """Return the elevation of the ground at a place in the image, m; independent of azimuth if level."""
        # `elevation_at` of height 0, but for the last bit: images depend on either
        level = slant_range * self.slope
        return level if self.level else level - azimuth * self.lean

    def range_on_ground(self, azimuth: Any, elevation: Lengths) -> Lengths:
        """Return the slant range at which a ray ends on the ground, m; independent of azimuth if level."""
        level = elevation / self.slope
        return level if self.level else level + azimuth * (self.lean / self.slope)

    def elevation_at(self, azimuth: Any, slant_range: Lengths, height: Any) -> Lengths:
        """Return the elevation of a place of this height in the image, m; independent of azimuth if level."""
        level = (slant_range * self.sine + height) / self.height_per_elevation
        return level if self.level else level - azimuth * self.lean

    def rays_to_ground(self, azimuths: Ends, ranges: Ends, heights: Ends) -> tuple[Ends, Ends]:
        """Return bounds of the azimuths and elevations of rays that end on ground in this part of an image, m."""
        corners = [(x, r, z) for x in azimuths for r, z in zip(ranges, heights, strict=True)]
        elevations = [self.elevation_at(*corner) for corner in corners]
        return azimuths, (min(elevations), max(elevations))

    def rows_on_ground(self, first: float, step: float, height: float) -> tuple[float, float]:
        """Return the slant range at which a row of rays ends on the ground, and the step to the next row, m.

        `first` is the elevation of the first row, and `step` that between rows. It holds for all columns: only under a
        level azimuth axis are rays and pixels on the ground both in rows.
        """
        return (first * self._cosine - height) / self.sine, step / self.slope

    # ---- the vertical plane in which all rays of a column lie, if the azimuth axis is level --------------------------
    def in_section(self, ground_range: Lengths, height: Any) -> tuple[Lengths, Lengths]:
        """Convert ground range and height to elevation and slant range, m."""
        return ground_range * self.sine + height * self._cosine, self.slant_range(ground_range, height)

    def along_ray(self, elevation: Lengths, height: Any) -> Lengths:
        """Return the ground range at which a ray of an elevation has this height, m."""
        return (elevation - height * self._cosine) / self.sine

    # ---- power of the ground ----------------------------------------------------------------------------------------
    def beta0_of_gamma0(self, gamma0: Power) -> Power:
        """Convert γ⁰ of level ground to β⁰."""
        return gamma0 * self.slope

    def gamma0_of_beta0(self, beta0: Power) -> Power:
        """Convert β⁰ of level ground to γ⁰."""
        return beta0 / self.slope

    @property
    def _cosine(self) -> float:
        """Cos θ: slant range for each metre of ground range."""
        return float(self.frame[1, 2]) / self._cos_tilt

    @property
    def _cos_tilt(self) -> float:
        return 1 / math.hypot(1.0, self.lean)

    @property
    def _along_right(self) -> float:
        """Positive if the radar looks to the right."""
        (ahead_x, ahead_y), (x, y) = self.frame[2, :2], self._across
        return float(ahead_x * y - ahead_y * x)

    @property
    def _across(self) -> Float64[np.ndarray, " 2"]:
        """Level unit vector (x, y) across the line of sight: the azimuth axis without its tilt."""
        if self.level:
            return self.frame[0, :2]
        return self._cos_tilt * (self.frame[0, :2] - self.lean * self.frame[1, :2])
