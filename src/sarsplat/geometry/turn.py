"""Rotation of a target aloft between the frames of a pass, and its uncertainty (inverse SAR)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments, expect, is_number
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.place import direction_of, unit_of
from sarsplat.geometry.view import View

_FARTHEST_DEG = 36_000.0  # a hundred turns
_MAX_AXIS_STD_DEG, _MAX_RATE_STD = 10.0, 0.2
_SLOWEST, _FASTEST = 0.5, 2.0  # limits of rates, and of an image's stretch, relative to what was assumed
_TOLERANCE = 1e-3  # rad between a view's azimuth axis and that of its rotation


@dataclass(frozen=True)
class Turn:
    """Rotation of a target from the beginning of a pass to a frame.

    Frames of one pass have the same axis, name and standard deviations: the axis and the rate by which they were made,
    from the attitude at its beginning on, are wrong by the same. A rate that was taken for higher than it is makes all
    angles too large and cross-range too short; a wrong angle between axis and line of sight scales cross-range, too.

    Parameters
    ----------
    axis : (x, y, z)
        Axis of rotation, counter-clockwise seen from its tip, in the target's frame; of any length.
    angle_deg : float
        Rotation since the beginning of the pass, when the attitude is known; degrees, at most a hundred turns.
    axis_std_deg : float
        Standard deviation of the axis in either direction across it, degrees, at most 10; 0 if it is known exactly.
    rate_std : float
        Standard deviation of the rate of rotation as a share of it, at most 0.2; 0 if it is known exactly.
    name : str
        Name of the pass, which distinguishes passes of the same axis.

    Raises
    ------
    SarsplatError
        If the axis has no direction, or a number is out of range.
    """

    axis: tuple[float, float, float]
    angle_deg: float
    axis_std_deg: float = 0.0
    rate_std: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", tuple(direction_of(self.axis, "rotation axis").tolist()))
        limits = {
            "angle_deg": (-_FARTHEST_DEG, _FARTHEST_DEG, "degrees since the beginning of the pass"),
            "axis_std_deg": (0.0, _MAX_AXIS_STD_DEG, "degrees, and find an axis that is known less well another way"),
            "rate_std": (0.0, _MAX_RATE_STD, "a share of the rate, such as 0.03"),
        }
        for name, (low, high, give) in limits.items():
            value = getattr(self, name)
            if not is_number(value) or not low <= value <= high:  # also catches NaN
                raise SarsplatError(f"{name} {shown(value)} is not a number between {low:g} and {high:g}; give {give}")
            object.__setattr__(self, name, float(value))
        expect(str, name=self.name)

    @property
    def of_pass(self) -> tuple[object, ...]:
        """Fields that all frames of one pass share."""
        return self.name, self.axis, self.axis_std_deg, self.rate_std

    @property
    def uncertain(self) -> bool:
        """True unless axis and rate are known exactly."""
        return self.axis_std_deg > 0 or self.rate_std > 0

    def seen_from(self, line_of_sight: Float64[np.ndarray, " 3"] | Sequence[float | int]) -> View:
        """Return the frame's view from the line of sight, in the target's frame, at the beginning of the pass."""
        sight = direction_of(line_of_sight, "line of sight")
        return View.isar(turned(sight, self.axis, -self.angle_deg), self.axis)

    @checks_arguments
    def check(self, view: View) -> None:
        """Raise if a view is not one of a target with this rotation."""
        across = np.cross(view.direction, self._unit)
        if not view.aloft or np.linalg.norm(view.look.frame[0] * np.linalg.norm(across) - across) > _TOLERANCE:
            raise SarsplatError(
                f"{view!r} is not of a target that turns about {list(self.axis)}; give "
                "View.isar(line_of_sight, rotation_axis) with the axis of its turn"
            )

    @checks_arguments
    def corrected(self, view: View, tilts_deg: tuple[float, float], faster: float) -> View:
        """Return the view of a frame for a corrected axis and rate of the pass.

        Parameters
        ----------
        view : View
            View by the assumed axis and rate.
        tilts_deg : (float, float)
            Rotation of the axis in two directions across it, degrees.
        faster : float
            Increase of the rate relative to the assumed one.

        Returns
        -------
        View
            Stretched view: cross-range was scaled by the assumed rotation.
        """
        across = np.cross(np.eye(3)[np.abs(self._unit).argmin()], self._unit)
        across /= np.linalg.norm(across)
        tilt = tilts_deg[0] * across + tilts_deg[1] * np.cross(self._unit, across)
        length = float(np.linalg.norm(tilt))
        axis = turned(self._unit, tilt, length) if length else self._unit
        rate = min(max(1 + faster, _SLOWEST), _FASTEST)
        first = turned(view.direction, self._unit, self.angle_deg)  # at the beginning of the pass
        true = View.isar(turned(first, axis, -rate * self.angle_deg), axis)
        sines = [float(np.linalg.norm(np.cross(first, one))) for one in (axis, self._unit)]
        return replace(true, stretch=min(max(rate * sines[0] / sines[1], _SLOWEST), _FASTEST))

    @property
    def _unit(self) -> Float64[np.ndarray, " 3"]:
        return unit_of(self.axis)


def turned(
    vector: Float64[np.ndarray, " 3"], axis: Float64[np.ndarray, " 3"] | Sequence[float | int], angle_deg: float
) -> Float64[np.ndarray, " 3"]:
    """Rotate a vector counter-clockwise about an axis of any length, seen from its tip (O. Rodrigues, 1840)."""
    unit = unit_of(axis)
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return vector * cos + np.cross(unit, vector) * sin + unit * (unit @ vector) * (1 - cos)
