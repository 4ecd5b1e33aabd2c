"""How a radar sees the scene: where its image shows a place, how its waves come and go, and how the ground lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from jaxtyping import Float64

Lengths = TypeVar("Lengths", bound=Any)
"""A number, an array or a tensor; m."""

Power = TypeVar("Power", bound=Any)
"""A number, an array or a tensor; linear."""

Ends = tuple[float, float]
"""The lower and the upper one, m."""


@dataclass(frozen=True, eq=False)
class Look:
    """How a far-away radar sees places: all geometry that a view's angles imply.

    A place is x_r = R_r x_w in the radar frame: its azimuth and range are where the image shows it, its azimuth and
    elevation are on which ray it lies. Ground is level, at z = 0 unless a height is given; θ is the grazing angle, and
    τ the tilt.

    Parameters
    ----------
    frame : numpy.ndarray, float64 [3, 3]
        R_r, from the world. Rows, perpendicular to each other and of length 1: azimuth (direction of flight), elevation
        (⟂ to the line of sight, upwards), range (away from the radar). A rotation if the radar looks to the right, and
        its mirror image if it looks to the left.
    slope : float
        tan θ / cos τ: elevation for each metre of slant range on the ground, and so β⁰ over γ⁰ of the ground.
    lean : float
        tan τ: how much the azimuth axis rises for each metre of elevation that the elevation axis does.
    stretch : float
        Azimuth in the image for each metre of azimuth in the frame: 1 unless its cross-range is scaled otherwise, which
        is only of a target aloft.
    """

    frame: Float64[np.ndarray, "3 3"]
    slope: float
    lean: float
    stretch: float = 1.0

    @classmethod
    def of(
        cls,
        azimuth_deg: float,
        grazing_deg: float,
        tilt_deg: float = 0.0,
        left: bool = False,
        stretch: float = 1.0,
    ) -> Self:
        """From the angles of a view; source: SAR-GS, eq. (5), for a level azimuth axis and a radar that looks right."""
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
        """How a place's azimuth and slant range in the image grow along x, y and z: one row each."""
        return self.frame[[0, 2]] * np.array([[self.stretch], [1.0]])

    def in_frame(self, azimuth: Lengths, slant_range: Lengths) -> tuple[Lengths, Lengths]:
        """Azimuth and range in the frame of what the image shows there, m: the place's, but for its elevation."""
        return azimuth / self.stretch, slant_range

    @property
    def sine(self) -> float:
        """Slant range by which each metre of height is nearer, and cosine of the ground's incidence: sin θ."""
        return float(-self.frame[2, 2])

    @property
    def height_per_elevation(self) -> float:
        """By how much higher each metre of elevation is, where azimuth and slant range stay: cos θ cos τ."""
        return float(self.frame[1, 2])

    @property
    def height_per_azimuth(self) -> float:
        """By how much higher each metre of azimuth is, where elevation and slant range stay: cos θ sin τ."""
        return float(self.frame[0, 2])

    @property
    def level(self) -> bool:
        """Whether the azimuth axis is: then rays and pixels on level ground are both in rows."""
        return self.lean == 0

    # ---- places on the ground ----------------------------------------------------------------------------------------
    @property
    def ahead(self) -> Float64[np.ndarray, " 2"]:
        """(x, y) of the level unit vector away from the radar, in which shadows fall and ground range grows."""
        return self.frame[2, :2] / self._cosine

    @property
    def onto_ground(self) -> Float64[np.ndarray, "2 2"]:
        """(x, y) on the ground for each metre of azimuth, and for each of slant range."""
        across, away = self._across, self.frame[2, :2] / self._cosine**2
        if self.level:
            return np.stack([across, away])
        return np.stack([across / self._cos_tilt, away - self.lean * self.sine / self._cosine * across])

    @property
    def displaced(self) -> Float64[np.ndarray, " 2"]:
        """(x, y) by which what is one metre high is shown elsewhere than it stands: towards the radar if level."""
        towards = self.frame[2, :2] * self.frame[2, 2] / (1 - self.frame[2, 2] ** 2)
        return towards if self.level else towards + self.lean / self._cosine * self._across

    def disc_m(self, half_azimuth_m: float, half_range_m: float) -> float:
        """Radius of the largest disc of ground that lies within so many metres from the middle of the image."""
        across = half_azimuth_m / math.sqrt(1 - float(self.frame[0, 2]) ** 2)
        return min(across, self.ground_range(half_range_m))

    def ground_range(self, slant_range: Lengths, height: Any = 0.0) -> Lengths:
        """How far `ahead` of the origin what is imaged at a slant range lies, m."""
        return (slant_range + height * self.sine) / self._cosine

    def slant_range(self, ground_range: Lengths, height: Any = 0.0) -> Lengths:
        """Where in the image what lies so far `ahead` is, m."""
        return ground_range * self._cosine - height * self.sine

    def to_ground(self, azimuth: Lengths, slant_range: Lengths) -> tuple[Lengths, Lengths]:
        """Where on the ground the image shows a place: across, as a level flight looking right goes, and `ahead`, m."""
        ahead = self.ground_range(slant_range)
        level = azimuth if self.level else azimuth / self._cos_tilt - ahead * (self.lean * self.sine)
        return (level if self._along_right > 0 else -level), ahead

    def to_image(self, across: Lengths, ahead: Lengths) -> tuple[Lengths, Lengths]:
        """Azimuth and slant range at which the image shows such a place, m."""
        level = across if self._along_right > 0 else -across
        if not self.level:
            level = self._cos_tilt * (level + ahead * (self.lean * self.sine))
        return level, self.slant_range(ahead)

    def shadow_m(self, height: Lengths) -> Lengths:
        """How far `ahead` of its foot the shadow of what is so high ends on the ground, m."""
        return height / (self.slope * self._cos_tilt)

    def corner_m(self, azimuth_m: float, slant_range_m: float) -> float:
        """How far from the origin the farthest place is that the image shows so far from its middle, on the ground."""
        if self.level:
            return math.hypot(azimuth_m, self.ground_range(slant_range_m))
        across, away = self.onto_ground * np.array([[azimuth_m], [slant_range_m]])
        return max(math.hypot(*(across + away)), math.hypot(*(across - away)))

    # ---- rays and the ground -----------------------------------------------------------------------------------------
    def elevation_on_ground(self, azimuth: Any, slant_range: Lengths) -> Lengths:
        """Elevation of the ground that the image shows at a place, m; the same at every azimuth of a level axis."""
        # `elevation_at` of height 0, but for the last bit: images depend on either
        level = slant_range * self.slope
        return level if self.level else level - azimuth * self.lean

    def range_on_ground(self, azimuth: Any, elevation: Lengths) -> Lengths:
        """Slant range at which a ray ends on the ground, m; the same at every azimuth if the axis is level."""
        level = elevation / self.slope
        return level if self.level else level + azimuth * (self.lean / self.slope)

    def elevation_at(self, azimuth: Any, slant_range: Lengths, height: Any) -> Lengths:
        """Elevation of what is so high, where the image shows it, m; the same at every azimuth if the axis is level."""
        level = (slant_range * self.sine + height) / self.height_per_elevation
        return level if self.level else level - azimuth * self.lean

    def rays_to_ground(self, azimuths: Ends, ranges: Ends, heights: Ends) -> tuple[Ends, Ends]:
        """Azimuths and elevations of all rays that end on ground between two heights that a part of an image shows."""
        corners = [(x, r, z) for x in azimuths for r, z in zip(ranges, heights, strict=True)]
        elevations = [self.elevation_at(*corner) for corner in corners]
        return azimuths, (min(elevations), max(elevations))

    def rows_on_ground(self, first: float, step: float, height: float) -> tuple[float, float]:
        """Slant range at which a ray at a first elevation ends on the ground, and how much farther each next one, m.

        Rays of all columns end there: only under a level azimuth axis are rays and pixels on the ground both in rows.
        """
        return (first * self._cosine - height) / self.sine, step / self.slope

    # ---- the vertical plane in which all rays of a column lie, if the azimuth axis is level --------------------------
    def in_section(self, ground_range: Lengths, height: Any) -> tuple[Lengths, Lengths]:
        """Elevation and slant range of places, m."""
        return ground_range * self.sine + height * self._cosine, self.slant_range(ground_range, height)

    def along_ray(self, elevation: Lengths, height: Any) -> Lengths:
        """Ground range at which a ray at an elevation is so high, m."""
        return (elevation - height * self._cosine) / self.sine

    # ---- power of the ground ----------------------------------------------------------------------------------------
    def beta0_of_gamma0(self, gamma0: Power) -> Power:
        """β⁰ of ground with this γ⁰."""
        return gamma0 * self.slope

    def gamma0_of_beta0(self, beta0: Power) -> Power:
        """γ⁰ of ground with this β⁰."""
        return beta0 / self.slope

    @property
    def _cosine(self) -> float:
        """Slant range for each metre `ahead`: cos θ."""
        return float(self.frame[1, 2]) / self._cos_tilt

    @property
    def _cos_tilt(self) -> float:
        return 1 / math.hypot(1.0, self.lean)

    @property
    def _along_right(self) -> float:
        """Positive if the azimuth axis points to where it would if the radar looked to the right."""
        (ahead_x, ahead_y), (x, y) = self.frame[2, :2], self._across
        return float(ahead_x * y - ahead_y * x)

    @property
    def _across(self) -> Float64[np.ndarray, " 2"]:
        """(x, y) of the level unit vector across the line of sight: the azimuth axis without its tilt."""
        if self.level:
            return self.frame[0, :2]
        return self._cos_tilt * (self.frame[0, :2] - self.lean * self.frame[1, :2])
