"""Angular coverage of views: groups by set and grazing angle, gaps in azimuth, and evenly spread subsets."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sarsplat.data.dataset import Dataset
from sarsplat.geometry import View

_SAME_GRAZING_DEG = 1.0  # maximum step of sorted grazing angles within a group

_FEW_GROUPS, _FEW_EACH = 3, 3
"""Number of groups, and their mean number of views: with more groups of fewer views, all views are one group."""


@dataclass(frozen=True)
class Gap:
    """Range of azimuths without a view, clockwise from the first to the last; 360° if all views have one azimuth."""

    width_deg: float
    first_deg: float
    last_deg: float

    def __str__(self) -> str:
        return f"{self.width_deg:.4g}°, from {self.first_deg:.4g}° clockwise to {self.last_deg:.4g}°"


def largest_gap(azimuths_deg: Iterable[float]) -> Gap:
    """Return the largest gap between one or more azimuths, in any order and modulo 360°."""
    azimuths = np.unique(np.round(np.array(list(azimuths_deg)) % 360, 6) % 360)
    gaps = np.diff([*azimuths, azimuths[0] + 360])
    widest = int(gaps.argmax())
    return Gap(float(gaps[widest]), float(azimuths[widest]), float((azimuths[widest] + gaps[widest]) % 360))


@dataclass(frozen=True)
class ViewGroup:
    """Views of one set at (nearly) one grazing angle, in order of azimuth."""

    split: str
    views: tuple[View, ...]

    @property
    def azimuths_deg(self) -> list[float]:
        """Azimuths in [0, 360) degrees, ascending."""
        return [view.azimuth_deg % 360 for view in self.views]

    @property
    def grazing_deg(self) -> tuple[float, float]:
        """Lowest and highest grazing angle, degrees."""
        angles = [view.grazing_deg for view in self.views]
        return min(angles), max(angles)

    @property
    def gap(self) -> Gap:
        """Largest gap in azimuth."""
        return largest_gap(self.azimuths_deg)

    @property
    def step_deg(self) -> float | None:
        """Median step of azimuth except the largest gap, degrees; None if all views have one azimuth."""
        azimuths = np.unique(np.round(self.azimuths_deg, 6))
        steps = np.sort(np.diff([*azimuths, azimuths[0] + 360]))[:-1]
        return float(np.median(steps)) if len(steps) else None


def view_groups(dataset: Dataset) -> list[ViewGroup]:
    """Group the views of a dataset by set, then by grazing angle from low to high."""
    grouped = []
    for split in dataset.splits():
        views = [entry.view for entry in dataset.entries if entry.split == split]
        for group in by_grazing(views):
            ordered = sorted((views[k] for k in group), key=lambda view: view.azimuth_deg % 360)
            grouped.append(ViewGroup(split, tuple(ordered)))
    return grouped


def by_grazing(views: Sequence[View]) -> list[list[int]]:
    """Group indices of views by (nearly) equal grazing angle, from low to high; random angles are one group."""
    ordered = sorted(range(len(views)), key=lambda k: views[k].grazing_deg)
    steps = np.diff([views[k].grazing_deg for k in ordered])
    starts = [0, *(np.flatnonzero(steps > _SAME_GRAZING_DEG) + 1).tolist(), len(ordered)]
    groups = len(starts) - 1
    if groups > _FEW_GROUPS and len(ordered) < _FEW_EACH * groups:
        return [ordered]
    return [ordered[first:last] for first, last in itertools.pairwise(starts)]


def evenly_chosen(views: Sequence[View], count: int) -> list[int]:
    """Return indices of `count` views, even in azimuth; successive azimuths cycle through the grazing angles."""
    groups = by_grazing(views)
    if any(len(range(first, count, len(groups))) > len(group) for first, group in enumerate(groups)):
        groups = [[*range(len(views))]]
    azimuths = even_azimuths([view.azimuth_deg for view in views], count)
    return [
        group[index]
        for first, group in enumerate(groups)
        for index in nearest_to([views[k].azimuth_deg for k in group], azimuths[first :: len(groups)])
    ]


def even_azimuths(azimuths_deg: Sequence[float], count: int) -> list[float]:
    """Return azimuths k·360°/count, or `count` even ones across the covered range if a gap exceeds that step."""
    gap = largest_gap(azimuths_deg)
    if gap.width_deg <= 360 / count:
        return [k * 360 / count for k in range(count)]
    covered = 360 - gap.width_deg
    return [gap.last_deg + k * covered / (count - 1) for k in range(count)]


def nearest_to(azimuths_deg: Sequence[float], wanted_deg: Sequence[float]) -> list[int]:
    """Return the index of a distinct azimuth for each wanted one, with the least total distance."""
    from scipy.optimize import linear_sum_assignment  # slow to import, and not needed to describe files

    difference = np.subtract.outer(np.asarray(wanted_deg, dtype=float), np.asarray(azimuths_deg, dtype=float))
    _, chosen = linear_sum_assignment(np.abs((difference + 180) % 360 - 180))
    return [int(index) for index in chosen]
