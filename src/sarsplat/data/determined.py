"""Conditioning of the view directions: along which axis the training views determine positions worst.

An image fixes a position in azimuth and slant range, and says nothing of the third direction, the view's elevation y_r.
What all views together say of it is the mean of x_r x_rᵀ + z_r z_rᵀ = 1 − y_r y_rᵀ: its smallest eigenvalue is 1 where
every direction is fixed by every image, and 0 where one is fixed by none. A side of the target is seen by the views in
front of it only, each weighted by the area it sees; without that, two views from opposite sides would pass for a stereo
pair, though no surface but the roof is in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from sarsplat.geometry import View

_SIDES = 72
_HARDLY, _WEAKLY = 10.0, 3.0
"""Conditioning above which a shape cannot be determined, and above which it is uncertain; see the calibration in
docs/reference/checks.md."""

_GRAZINGS = (15.0, 30.0, 45.0, 60.0, 75.0)  # degrees: what may be proposed


@dataclass(frozen=True)
class WeakestDirection:
    """The direction along which the views determine positions worst, and by how much.

    Attributes
    ----------
    conditioning : float
        How many times less well a position is determined there than within an image: the inverse root of the smallest
        eigenvalue, averaged over the sides of the target that are seen; infinite if not at all.
    above_horizon_deg : float
        The direction's angle above the horizon, degrees; of the side for which it is weakest.
    """

    conditioning: float
    above_horizon_deg: float

    @property
    def uncertain(self) -> bool:
        """Whether the views determine the shape badly, if at all."""
        return self.conditioning > _WEAKLY

    @property
    def undetermined(self) -> bool:
        """Whether the views cannot determine the shape."""
        return self.conditioning > _HARDLY

    def __str__(self) -> str:
        where = f"{self.above_horizon_deg:.0f}° above the horizon"
        if self.undetermined:
            return f"{where}; positions are not determined along it"
        return (
            f"{where}; positions are {self.conditioning:.1f} times less well determined along it than within an image"
        )


def weakest_direction(views: Sequence[View]) -> WeakestDirection:
    """The direction along which positions are determined least, for sides of a target that face all azimuths."""
    frames = np.array([view.look.frame for view in views])
    azimuths = np.arange(_SIDES) * (2 * math.pi / _SIDES)
    normals = np.stack([np.cos(azimuths), -np.sin(azimuths), np.zeros(_SIDES)], axis=1)
    seen = np.maximum(normals @ -frames[:, 2].T, 0.0)  # [sides, views]
    seen[seen < 1e-6] = 0.0  # rounding, of views along a side
    seen = seen[seen.any(axis=1)]
    left_open = _average(seen, frames[:, 1])
    values, vectors = np.linalg.eigh(left_open)
    fixed = np.maximum(1 - values[:, -1], 0.0)
    direction = vectors[fixed.argmin(), :, -1]
    conditioning = 1 / math.sqrt(fixed.mean()) if fixed.mean() > 1e-9 else math.inf
    return WeakestDirection(conditioning, math.degrees(math.asin(min(abs(direction[2]), 1.0))))


def _average(weights: Float64[np.ndarray, "s v"], y: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "s 3 3"]:
    return np.einsum("sv,vi,vj->sij", weights / weights.sum(axis=1, keepdims=True), y, y)


def weak_directions(views: Sequence[View]) -> list[str]:
    """Whether the views leave a direction (nearly) open: one sentence that says which and what to add, or none."""
    weakest = weakest_direction(views)
    if not weakest.uncertain:
        return []
    best = min(_GRAZINGS, key=lambda grazing: weakest_direction(_with_grazing(views, grazing)).conditioning)
    where = f"along directions {weakest.above_horizon_deg:.0f}° above the horizon"
    if weakest.undetermined:
        verdict = f"do not determine positions {where}, and so not the shape"
    else:
        less = f"{weakest.conditioning:.1f} times less well {where} than within an image"
        verdict = f"determine positions {less}, so the shape is uncertain"
    return [f"the {len(views)} training views {verdict}; add views at other grazing angles, such as {best:g}°"]


def _with_grazing(views: Sequence[View], grazing_deg: float) -> list[View]:
    return [*views, *(replace(view, grazing_deg=grazing_deg) for view in views)]
