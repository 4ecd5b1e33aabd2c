"""Views: directions to a far-away radar, and the orientation of its images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments, described, expect, is_number
from sarsplat.errors import SarsplatError
from sarsplat.geometry.grids import ImageGrid
from sarsplat.geometry.look import Look
from sarsplat.geometry.place import direction_of, unit_of
from sarsplat.names import RadarSide

_MAX_AZIMUTH = 3600  # degrees: ten turns
_STEEPEST = 89.999  # degrees: there is no azimuth at the zenith
_MAX_TILT = 89.0  # degrees: at 90 the image shows level ground edge-on, as a line
_ALOFT_BETA0 = 0.5  # the best of 0.2 to 1 in masks of boxes
_LEVEL_DEG = 1e-9  # smaller tilts, computed from vectors, are rounding errors
_TILT_SPREAD_DEG = 1.0  # maximum spread of the tilts of one radar: those of measured images scatter
_MIN_SINE = 1e-3  # of the angle between line of sight and rotation axis: rotation about the former has no Doppler

_MAX_STRETCH = 2.0

_NUMBERS = {"azimuth_deg": "azimuth", "grazing_deg": "grazing angle", "tilt_deg": "tilt", "stretch": "stretch"}


@dataclass(frozen=True)
class View:
    """Direction to a far-away radar, and the orientation of its image.

    Parameters
    ----------
    azimuth_deg : float
        Azimuth φ of the radar seen from the scene, degrees, clockwise seen from above, from +x; at most ten turns,
        ±3600°.
    grazing_deg : float
        Grazing angle θ, degrees in (0, 90): elevation of the radar seen from the scene
        (the depression angle over a flat earth; incidence = 90° − grazing).
    tilt_deg : float
        Angle τ by which the azimuth axis of the image, the direction of flight, rises above the level one, turned about
        the line of sight, degrees, at most ±89: 0 unless the radar squints, climbs or dives.
    side : {"right", "left"}
        On which side of its flight the radar looks: the image of one is the mirror image of the other's.
    aloft : bool
        The target is in free space: there is no ground at z = 0, and the radar may be below, at a grazing angle down to
        −90°, and the tilt be 90°. See `isar`.
    stretch : float
        Length along azimuth in the image for each metre of a target aloft, ½ to 2: 1 unless its cross-range was scaled
        by a rate of rotation, or an axis, that was not the true one, as trainings find out (`sarsplat.Turn`).

    Raises
    ------
    SarsplatError
        If an angle is not a number, the azimuth exceeds ten turns, the grazing angle lies outside (0°, 90°), the tilt
        exceeds 89°, there is no such side, or the image is stretched by too much or of a target on the ground.
    """

    azimuth_deg: float
    grazing_deg: float
    tilt_deg: float = 0.0
    side: RadarSide = "right"
    aloft: bool = False
    stretch: float = 1.0

    def __post_init__(self) -> None:
        for field, name in _NUMBERS.items():
            value = getattr(self, field)
            if not is_number(value):
                raise SarsplatError(
                    f"{name} is {described(value)}; give a number (views have no gradients: instead of a view, turn "
                    "the means of Gaussians)"
                )
            object.__setattr__(self, field, float(value))  # JSON cannot hold numpy's numbers
        if not isinstance(self.aloft, bool):  # a stretch may be meant
            raise SarsplatError(f"aloft is {described(self.aloft)}; give True or False")
        lowest = -90.0 if self.aloft else 0.0
        if not lowest < self.grazing_deg < 90.0:  # also catches NaN
            raise SarsplatError(
                f"grazing angle {self.grazing_deg}° is outside ({lowest:g}°, 90°); "
                "give degrees above the horizon (grazing = 90° − incidence)"
            )
        steepest = 90.0 if self.aloft else _MAX_TILT
        for name, value, low, high, give in (
            ("azimuth", self.azimuth_deg, -_MAX_AZIMUTH, _MAX_AZIMUTH, "degrees, such as 0 to 360"),
            ("tilt", self.tilt_deg, -steepest, steepest, "how far the azimuth axis rises above the level one, degrees"),
            ("stretch", self.stretch, 1 / _MAX_STRETCH, _MAX_STRETCH, "1"),
        ):
            if not low <= value <= high:  # also catches NaN
                raise SarsplatError(f"{name} {value} is not a number between {low:g} and {high:g}; give {give}")
        expect(RadarSide, side=self.side)
        if self.stretch != 1 and not self.aloft:
            raise SarsplatError("only images of a target aloft can be stretched; give stretch 1")

    def __repr__(self) -> str:
        """Constructor call without the arguments at their defaults."""
        return f"View({', '.join(f'{name}={value!r}' for name, value in self.as_dict().items())})"

    def as_dict(self) -> dict[str, float | str]:
        """Return the arguments that differ from their defaults, for JSON."""
        return {name: value for name, value in vars(self).items() if value != getattr(type(self), name, None)}

    @property
    def unusual(self) -> str:
        """Suffix to the angles in text, such as ", tilted by 5°, looking left"; empty for most views."""
        tilt = f", tilted by {tenths:g}°" if (tenths := round(self.tilt_deg, 1)) else ""
        side = ", looking left" if self.side == "left" else ""
        return tilt + side + ("" if self.stretch == 1 else f", stretched by {self.stretch:.3f}")

    @property
    def open_beta0(self) -> float:
        """β⁰ of open ground with γ⁰ = 1, the reference of masks; aloft, of a plane seen at 27°."""
        return _ALOFT_BETA0 if self.aloft else self.look.beta0_of_gamma0(1.0)

    @property
    def yardstick(self) -> float:
        """Factor on the threshold of masks: a tilted pixel shows more of the ground, but no more of a target."""
        return 1.0 if self.aloft else math.cos(math.radians(self.tilt_deg))

    @classmethod
    @checks_arguments
    def towards(cls, direction: Float64[np.ndarray, " 3"] | Sequence[float], *, aloft: bool = False) -> Self:
        """Return the view from a direction, above the horizon unless aloft, of any length; the zenith is 89.999°."""
        x, y, z = map(float, direction_of(direction, "direction to the radar"))
        grazing = math.degrees(math.atan2(z, math.hypot(x, y)))
        return cls(math.degrees(math.atan2(-y, x)) % 360.0, max(min(grazing, _STEEPEST), -_STEEPEST), aloft=aloft)

    @classmethod
    @checks_arguments
    def isar(
        cls,
        line_of_sight: Float64[np.ndarray, " 3"] | Sequence[float | int],
        rotation_axis: Float64[np.ndarray, " 3"] | Sequence[float | int],
    ) -> Self:
        """Return the view of a radar that images a target in free space by its rotation (inverse SAR).

        Azimuth is cross-range, perpendicular to both: as Doppler frequency f of wavelength λ, it is λ f / (2 Ω sin α)
        of a target that turns by Ω rad/s about an axis α away from the line of sight.

        Parameters
        ----------
        line_of_sight : (x, y, z)
            From the target to the radar, in the target's frame, of any length; it is kept 0.001° away from ±z.
        rotation_axis : (x, y, z)
            About which the target turns, counter-clockwise seen from its tip, in the same frame, of any length.

        Raises
        ------
        SarsplatError
            If they are along the same line, or one has no direction.
        """
        sight, axis = direction_of(line_of_sight, "line of sight"), direction_of(rotation_axis, "rotation axis")
        level = cls.towards(sight, aloft=True)
        along = np.cross(level.direction, unit_of(axis))  # as the radar moves, seen from the target
        if not np.linalg.norm(along) > _MIN_SINE:
            raise SarsplatError(
                f"the rotation axis {axis.tolist()} is along the line of sight, from where nothing is seen to turn; "
                "give another"
            )
        across, elevation = level.look.frame[:2] @ along
        tilt = math.degrees(math.atan2(elevation, abs(across)))
        if abs(tilt) < _LEVEL_DEG:
            tilt = 0.0
        return replace(level, tilt_deg=tilt, side="left" if across < 0 else "right")

    @property
    def incidence_deg(self) -> float:
        """Incidence angle against the vertical, degrees."""
        return 90.0 - self.grazing_deg

    @property
    def look(self) -> Look:
        """Geometry of the view: image, rays and ground."""
        return Look.of(self.azimuth_deg, self.grazing_deg, self.tilt_deg, self.side == "left", self.stretch)

    @property
    def direction(self) -> Float64[np.ndarray, " 3"]:
        """Unit vector u from the scene to the radar, world frame, float64 [3]."""
        return self.look.facing


def unstretched(views: Sequence[View]) -> list[View]:
    """Return the views without their stretch."""
    return [replace(view, stretch=1.0) for view in views]


def check_unstretched(views: Sequence[View], remedy: str = "use render, or give stretch 1") -> None:
    """Raise if a view is stretched."""
    if any(view.stretch != 1 for view in views):
        raise SarsplatError(f"a view is stretched, which is not supported here; {remedy}")


def seen_alike(views: Sequence[View], azimuth_deg: float, grazing_deg: float) -> View:
    """Return the view from a direction by a radar like that of known views, at least one.

    It has their side and their median tilt if sides agree and tilts differ by at most a degree. Otherwise it is level
    and looks to the right.
    """
    tilts = sorted(view.tilt_deg for view in views)
    level = View(azimuth_deg, grazing_deg, aloft=views[0].aloft)
    if tilts[-1] - tilts[0] > _TILT_SPREAD_DEG or len({view.side for view in views}) > 1:
        return level
    return replace(level, tilt_deg=tilts[len(tilts) // 2], side=views[0].side)


def ground_radius_m(views: Sequence[View], grid: ImageGrid) -> float:
    """Return the radius of the ground that images show, m, with a margin for footprints and responses."""
    across = grid.columns * grid.spacing_m[0] + 2 * abs(grid.center_m[0])
    away = grid.rows * grid.spacing_m[1] + 2 * abs(grid.center_m[1])
    return max(view.look.corner_m(across / 2, away / 2) for view in views) + 2 * max(grid.resolution_m)


@checks_arguments
def radar_frame(view: View) -> Float64[np.ndarray, "3 3"]:
    """Return R_r from the world to the radar frame, x_r = R_r x_w.

    Returns
    -------
    numpy.ndarray, float64 [3, 3]
        Rows: azimuth (direction of flight), elevation (⟂ to the line of sight), range (away from the radar).

    Notes
    -----
    Source: SAR-GS, eq. (5); a proper rotation, or its mirror image if the radar looks to the left.
    """
    return view.look.frame
