"""Rigid alignment of reconstructed points with a known surface, by a small motion.

A measured target stands somewhere near the middle of its chips, with a heading as accurate as its label. That
offset says nothing about the reconstruction, so points may be moved before they are scored, but only a little, so that
no other error is hidden.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

_FARTHEST = 3.0  # cells, along each axis; distances beyond it count as this
MOST_TURNED_DEG = 5.0
"""Largest rotation of the points, degrees."""

_COUNT = 4000  # of the points, and of the surface's samples


@dataclass(frozen=True)
class Alignment:
    """A turn about the vertical through the origin, then a shift."""

    shift_m: tuple[float, float, float]
    """World frame, m."""
    heading_deg: float
    """Counter-clockwise seen from above, degrees."""
    farthest_m: float = math.inf
    """Largest shift allowed along each axis, m."""

    def moved(self, points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Return the points rotated and shifted, m."""
        return points @ _turn(self.heading_deg).T + np.array(self.shift_m)

    @property
    def at_limit(self) -> bool:
        """Whether the shift or the rotation ended at its limit."""
        parts = [*(abs(part) / self.farthest_m for part in self.shift_m), abs(self.heading_deg) / MOST_TURNED_DEG]
        return max(parts) > 0.98

    def __str__(self) -> str:
        x, y, z = self.shift_m
        return f"moved by {x:.2f}, {y:.2f}, {z:.2f} m and turned by {self.heading_deg:.1f}°"


def align(points: Float[np.ndarray, "p 3"], surface: Float[np.ndarray, "s 3"], cell: float) -> Alignment:
    """The motion after which points and surface are nearest to each other, on average over both.

    Parameters
    ----------
    points : numpy.ndarray, float [P, 3]
        Reconstructed points, m.
    surface : numpy.ndarray, float [S, 3]
        Samples of the known surface, m, spread by area.
    cell : float
        Side of a resolution cell, m. Points are moved by at most three cells, and distances are capped there.
    """
    from scipy.optimize import minimize  # here, because it takes half a second to import, and few ask for it

    rng = np.random.default_rng(0)
    own, true = (np.asarray(cloud, np.float64)[rng.permutation(len(cloud))[:_COUNT]] for cloud in (points, surface))
    farthest = _FARTHEST * cell
    to_own, to_true = cKDTree(own), cKDTree(true)

    def apart(motion: Float64[np.ndarray, " 4"]) -> float:
        shift, turn = motion[:3] * farthest, _turn(motion[3] * MOST_TURNED_DEG)
        distances = (
            to_true.query(own @ turn.T + shift, distance_upper_bound=farthest)[0],
            to_own.query((true - shift) @ turn, distance_upper_bound=farthest)[0],
        )
        return sum(float(np.minimum(each, farthest).mean()) for each in distances)

    best = minimize(apart, np.zeros(4), method="Powell", bounds=[(-1, 1)] * 4, options={"xtol": 1e-3, "ftol": 1e-5}).x
    x, y, z = (float(part) for part in best[:3] * farthest)
    return Alignment((x, y, z), float(best[3]) * MOST_TURNED_DEG, farthest)


def _turn(heading_deg: float) -> Float64[np.ndarray, "3 3"]:
    cosine, sine = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
