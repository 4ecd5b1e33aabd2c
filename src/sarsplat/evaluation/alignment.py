"""Rigid alignment of reconstructed points with a known surface, by a small motion.

Measured targets are near the middle of their chips and have a heading as accurate as the label; targets aloft are
rotated by errors of their assumed rotation. These offsets are no errors of the reconstruction, so points may be moved
before they are scored, but only a little, so that no other error is hidden.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

_FARTHEST = 3.0  # largest shift along each axis, and cap of distances, resolution cells
MOST_TURNED_DEG = 5.0
"""Largest rotation of the points, degrees."""

_COUNT = 4000  # points and surface samples used


@dataclass(frozen=True)
class Alignment:
    """Rotations about the origin, about x, y and then the vertical, followed by a shift."""

    shift_m: tuple[float, float, float]
    """Shift in the world frame, m."""
    heading_deg: float
    """Rotation about the vertical, degrees, counter-clockwise from above."""
    farthest_m: float = math.inf
    """Largest shift allowed along each axis, m."""
    tilts_deg: tuple[float, float] = (0.0, 0.0)
    """Rotations about x and y, degrees; 0 unless the target is aloft."""

    def moved(self, points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Return the points rotated and shifted, m."""
        return points @ _turn(self.heading_deg, *self.tilts_deg).T + np.array(self.shift_m)

    @property
    def at_limit(self) -> bool:
        """True if the shift or the rotation ended at its limit."""
        turns = self.heading_deg, *self.tilts_deg
        parts = (abs(part) / self.farthest_m for part in self.shift_m)
        return max(*parts, *(abs(turn) / MOST_TURNED_DEG for turn in turns)) > 0.98

    def __str__(self) -> str:
        x, y, z = self.shift_m
        tilts = " and ".join(f"{tilt:.1f}°" for tilt in self.tilts_deg)
        aloft = f", about x and y by {tilts}" if any(self.tilts_deg) else ""
        return f"moved by {x:.2f}, {y:.2f}, {z:.2f} m and turned by {self.heading_deg:.1f}°{aloft}"


def align(
    points: Float[np.ndarray, "p 3"], surface: Float[np.ndarray, "s 3"], cell: float, *, aloft: bool = False
) -> Alignment:
    """Find the motion that minimises the mean distances from points to surface and back.

    Parameters
    ----------
    points : numpy.ndarray, float [P, 3]
        Reconstructed points, m.
    surface : numpy.ndarray, float [S, 3]
        Samples of the known surface, m, spread by area.
    cell : float
        Side of a resolution cell, m. Points are moved by at most three cells, and distances are capped there.
    aloft : bool
        Rotate about all axes, not only about the vertical.
    """
    from scipy.optimize import minimize  # here: half a second to import

    rng = np.random.default_rng(0)
    own, true = (np.asarray(cloud, np.float64)[rng.permutation(len(cloud))[:_COUNT]] for cloud in (points, surface))
    farthest = _FARTHEST * cell
    to_own, to_true = cKDTree(own), cKDTree(true)

    def distance(motion: Float64[np.ndarray, " n"]) -> float:
        shift, turn = motion[:3] * farthest, _turn(*(motion[3:] * MOST_TURNED_DEG))
        distances = (
            to_true.query(own @ turn.T + shift, distance_upper_bound=farthest)[0],
            to_own.query((true - shift) @ turn, distance_upper_bound=farthest)[0],
        )
        return sum(float(np.minimum(one, farthest).mean()) for one in distances)

    free, options = 6 if aloft else 4, {"xtol": 1e-3, "ftol": 1e-5}
    best = minimize(distance, np.zeros(free), method="Powell", bounds=[(-1, 1)] * free, options=options).x
    x, y, z = (float(part) for part in best[:3] * farthest)
    heading_deg, tilt_x, tilt_y = (float(turn) * MOST_TURNED_DEG for turn in (*best[3:], 0.0, 0.0)[:3])
    return Alignment((x, y, z), heading_deg, farthest, (tilt_x, tilt_y))


def _turn(heading_deg: float, tilt_x_deg: float = 0.0, tilt_y_deg: float = 0.0) -> Float64[np.ndarray, "3 3"]:
    turn = np.eye(3)
    for axis, angle_deg in enumerate((tilt_x_deg, tilt_y_deg, heading_deg)):
        if angle_deg or axis == 2:
            cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
            around = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            turn = np.roll(around, axis - 2, axis=(0, 1)) @ turn
    return turn
