"""Detects running numbers in place of azimuths: 1°, 2°, 3° … one for each image."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sarsplat.geometry import View

_SAME_DEG = 1e-6
_LEAST_GAP_DEG = 60.0
"""Left out by numbers that cannot be azimuths all round: across it no images are compared (see `neighbours`)."""


@dataclass(frozen=True)
class Counting:
    """Azimuths that are whole degrees one after another and leave out a part of the circle."""

    first_deg: float
    """Where they begin, clockwise."""
    last_deg: float
    """Where they end."""
    spread: list[View]
    """The same views, with those of each grazing angle evenly all round in their order."""

    @property
    def from_one(self) -> bool:
        """Whether they begin with 0° or 1°, or end there, counted counter-clockwise."""
        return self.first_deg in (0.0, 1.0) or self.last_deg % 360 in (0.0, 359.0)


def counting(views: Sequence[View]) -> Counting | None:
    """What the azimuths count, if each is one degree more than another and no two are the same."""
    azimuths = np.array([view.azimuth_deg for view in views]) % 360
    order = np.argsort(azimuths)
    gaps = (np.roll(azimuths[order], -1) - azimuths[order]) % 360
    widest = int(gaps.argmax())
    if len(views) < 3 or gaps[widest] < _LEAST_GAP_DEG or (abs(np.delete(gaps, widest) - 1) > _SAME_DEG).any():
        return None
    order = np.roll(order, -widest - 1)
    groups: dict[float, list[int]] = defaultdict(list)
    for index in order.tolist():
        groups[views[index].grazing_deg].append(index)
    spread = list(views)
    for group in groups.values():
        for place, index in enumerate(group):
            spread[index] = replace(views[index], azimuth_deg=place * 360 / len(group))
    return Counting(float(azimuths[order[0]]), float(azimuths[order[-1]]), spread)
