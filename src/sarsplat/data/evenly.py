"""Training views that stand as evenly around the target as the images allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from sarsplat.data.coverage import largest_gap


def even_azimuths(azimuths_deg: Sequence[float], count: int) -> list[float]:
    """Azimuths k·360°/count; if images leave out more of the circle than one such step, as many within what they cover.

    Parameters
    ----------
    azimuths_deg : sequence of float
        Of the images, degrees; at least one.
    count : int
        How many are wanted.
    """
    gap = largest_gap(azimuths_deg)
    if gap.width_deg <= 360 / count:
        return [k * 360 / count for k in range(count)]
    covered = 360 - gap.width_deg
    return [gap.last_deg + k * covered / (count - 1) for k in range(count)]


def nearest_to(azimuths_deg: Sequence[float], wanted_deg: Sequence[float]) -> list[int]:
    """Distinct images nearest to the azimuths that are wanted, one for each, in their order.

    Parameters
    ----------
    azimuths_deg : sequence of float
        Of the images, degrees; at least as many as are wanted.
    wanted_deg : sequence of float
        Degrees.

    Notes
    -----
    The total distance is the least possible: where two azimuths want the same image, they share out.
    """
    apart = np.subtract.outer(np.asarray(wanted_deg, dtype=float), np.asarray(azimuths_deg, dtype=float))
    _, chosen = linear_sum_assignment(np.abs((apart + 180) % 360 - 180))
    return [int(index) for index in chosen]
