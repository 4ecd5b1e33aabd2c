"""Selection of training views spread evenly in azimuth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sarsplat.data.coverage import by_grazing, largest_gap
from sarsplat.geometry import View


def evenly_chosen(views: Sequence[View], count: int) -> list[int]:
    """Indices of `count` of the views: even in azimuth, where every grazing angle gets the next azimuth in turn."""
    groups = by_grazing(views)
    if any(len(range(first, count, len(groups))) > len(group) for first, group in enumerate(groups)):
        groups = [[*range(len(views))]]
    wanted = even_azimuths([view.azimuth_deg for view in views], count)
    return [
        group[index]
        for first, group in enumerate(groups)
        for index in nearest_to([views[k].azimuth_deg for k in group], wanted[first :: len(groups)])
    ]


def even_azimuths(azimuths_deg: Sequence[float], count: int) -> list[float]:
    """Azimuths k·360°/count; if a gap is wider than one such step, as many within what the images cover."""
    gap = largest_gap(azimuths_deg)
    if gap.width_deg <= 360 / count:
        return [k * 360 / count for k in range(count)]
    covered = 360 - gap.width_deg
    return [gap.last_deg + k * covered / (count - 1) for k in range(count)]


def nearest_to(azimuths_deg: Sequence[float], wanted_deg: Sequence[float]) -> list[int]:
    """Indices of distinct azimuths, one for each that is wanted and in its order, at the least total distance."""
    from scipy.optimize import linear_sum_assignment  # here, because what describes files does without it

    apart = np.subtract.outer(np.asarray(wanted_deg, dtype=float), np.asarray(azimuths_deg, dtype=float))
    _, chosen = linear_sum_assignment(np.abs((apart + 180) % 360 - 180))
    return [int(index) for index in chosen]
