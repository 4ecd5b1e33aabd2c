"""The views of a flight around the target, or over it, that ends where it began."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.names import Swept


def sweep_views(
    swept: Swept,
    frames: int,
    training: Sequence[View],
    *,
    ends_deg: tuple[float, float] | None = None,
    other_deg: float | None = None,
) -> list[View]:
    """Views in which one angle changes and the other stays; played again and again, they never jump.

    Parameters
    ----------
    swept : "azimuth" or "grazing"
        The angle that changes.
    frames : int
        Number of views, at least 2.
    training : sequence of View
        Decides what is not given.
    ends_deg : (float, float), optional
        Between which angles the sweep goes, there and back, slower at its ends. Without them, azimuths make a whole
        turn, and grazing angles go between the lowest and the highest training view.
    other_deg : float, optional
        The angle that stays: by default, the middle one of the training views' grazing angles, or the azimuth of the
        first of them.
    """
    if frames < 2:
        raise SarsplatError(f"a sweep of {frames} frames does not move; give at least 2")
    grazing = sorted(view.grazing_deg for view in training)
    if swept == "grazing" and ends_deg is None:
        ends_deg = grazing[0], grazing[-1]
        if ends_deg[1] - ends_deg[0] < 1:
            raise SarsplatError(
                f"all training views have the grazing angle {grazing[0]:g}°, so where the sweep begins and ends has "
                "to be given; for example --grazing 10 60"
            )
    if ends_deg is None:
        moving = [360 * k / frames for k in range(frames)]
    elif ends_deg[0] == ends_deg[1]:
        raise SarsplatError(f"the sweep begins and ends at {ends_deg[0]:g}°; give two different angles")
    else:
        first, last = ends_deg
        moving = [first + (last - first) * (1 - math.cos(2 * math.pi * k / frames)) / 2 for k in range(frames)]
    moving = [round(angle, 6) for angle in moving]  # the way back has the same angles
    if swept == "azimuth":
        stays = grazing[len(grazing) // 2] if other_deg is None else other_deg
        return [View(angle, stays) for angle in moving]
    stays = training[0].azimuth_deg if other_deg is None else other_deg
    return [View(stays, angle) for angle in moving]
