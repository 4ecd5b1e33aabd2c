"""Grid lines on the ground, clipped where they would cross the SAR image that is shown below the ground."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Polygon = Float[np.ndarray, "n 2"]
"""Corners of a convex polygon on the ground, m, in order."""


def ground_lines(
    middle: Float[np.ndarray, " 3"], reach_m: float, step_m: float, hidden: Polygon
) -> Float[np.ndarray, "s 2 3"]:
    """A square grid up to `reach_m` from its middle, m: its lines as segments, without what lies inside `hidden`."""
    count = int(reach_m // step_m)
    segments = []
    for along in (0, 1):
        for offset in step_m * np.arange(-count, count + 1):
            place = float(middle[1 - along] + offset)
            first, last = float(middle[along] - reach_m), float(middle[along] + reach_m)
            leaves, returns = _crossed(hidden, 1 - along, place) or (last, last)
            for start, end in ((first, min(leaves, last)), (max(returns, first), last)):
                if start < end:
                    ends = np.empty((2, 3))
                    ends[:, along], ends[:, 1 - along], ends[:, 2] = (start, end), place, middle[2]
                    segments.append(ends)
    return np.stack(segments)


def seen_through(corners: Float[np.ndarray, "corners 3"], eye: Float[np.ndarray, " 3"]) -> Polygon:
    """Where on the ground, z = 0, a flat picture with these corners is seen through it from `eye`, m.

    Of a picture without corners, or one that is on the eye's side, nothing is.
    """
    side = 1.0 if eye[2] >= 0 else -1.0
    heights = side * corners[:, 2]
    places = []
    for one, two, here, there in zip(corners, np.roll(corners, -1, axis=0), heights, np.roll(heights, -1), strict=True):
        if here <= 0:
            places.append(one)
        if (here < 0) != (there < 0):  # its edge goes through the ground
            places.append(one + here / (here - there) * (two - one))
    if not places or eye[2] == 0:
        return np.empty((0, 2))
    beyond = np.stack(places)
    share = eye[2] / (eye[2] - beyond[:, 2])
    projected: Polygon = (eye + share[:, None] * (beyond - eye))[:, :2]
    return projected


def _crossed(polygon: Polygon, axis: int, place: float) -> tuple[float, float] | None:
    """The part of the line at `place` of an axis that is inside a convex polygon, along the other axis."""
    found = []
    for one, two in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if (one[axis] < place) != (two[axis] < place):
            share = (place - one[axis]) / (two[axis] - one[axis])
            found.append(float(one[1 - axis] + share * (two[1 - axis] - one[1 - axis])))
    return (min(found), max(found)) if found else None
