"""One picture under two directions: the same pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sarsplat.data.dataset import Dataset
from sarsplat.errors import counted
from sarsplat.geometry import View

_SAME_DIRECTION_DEG = 0.01
_USUAL_TURN_DEG = 30.0
_LEAST = 1e-30
_ROUNDED = 0.02
"""Of the brightest pixel: by how much images that are the same by symmetry differ, by rounding or by rays."""


def repeated_images(dataset: Dataset) -> list[str]:
    """Whether images are the same, pixel by pixel, though of other directions, or twice in one set; a sentence each.

    Images without speckle may be the same by the target's symmetry: then all that are as far apart are.
    """
    first: dict[bytes, int] = {}
    pairs = []
    for index, image in enumerate(dataset.power):
        if (at := first.setdefault(image.tobytes(), index)) != index and np.ptp(image) > 0:
            pairs.append((at, index))
    apart = [(i, j) for i, j in pairs if _apart_deg(dataset.views[i], dataset.views[j]) > _SAME_DIRECTION_DEG]
    twice = [(i, j) for i, j in pairs if (i, j) not in apart and dataset.entries[i].split == dataset.entries[j].split]
    apart = [pair for pair in apart if not _symmetric(dataset, *pair)]
    return [*_said_of_pairs(dataset, apart), *_said_of_twice(dataset, twice)]


def _said_of_twice(dataset: Dataset, pairs: Sequence[tuple[int, int]]) -> list[str]:
    if not pairs:
        return []
    one, other = (dataset.entries[k].name for k in pairs[0])
    return [
        f"{one} and {other} are one and the same picture from one direction{_more(pairs)}, which counts twice; remove "
        "one"
    ]


def _apart_deg(one: View, other: View) -> float:
    """Angle between two directions, degrees."""
    return math.degrees(math.acos(min(max(float(one.direction @ other.direction), -1.0), 1.0)))


def _symmetric(dataset: Dataset, i: int, j: int) -> bool:
    """Whether most other pairs of images that are turned as far against each other are the same, too, but for rounding.

    If there are no others, a target without speckle may still be the same after turns by quarters or sixths.
    """
    views = dataset.views
    if abs(views[i].grazing_deg - views[j].grazing_deg) > 1e-6:
        return False
    turn = views[j].azimuth_deg - views[i].azimuth_deg
    at = {(round(view.azimuth_deg % 360, 4) % 360, round(view.grazing_deg, 4)): k for k, view in enumerate(views)}
    others = [
        (k, other)
        for (azimuth, grazing), k in at.items()
        if (other := at.get((round((azimuth + turn) % 360, 4) % 360, grazing))) is not None and {k, other} != {i, j}
    ]
    if not others:
        return dataset.looks is None and abs(turn / _USUAL_TURN_DEG - round(turn / _USUAL_TURN_DEG)) < 1e-6
    pairs = ((dataset.power[k], dataset.power[other]) for k, other in others)
    return bool(
        np.median([np.abs(one - two).max() / max(one.max(), two.max(), _LEAST) for one, two in pairs]) < _ROUNDED
    )


def _said_of_pairs(dataset: Dataset, pairs: Sequence[tuple[int, int]]) -> list[str]:
    if not pairs:
        return []
    entries = [dataset.entries[k] for k in pairs[0]]
    one, other = (f"{e.name} (azimuth {e.view.azimuth_deg:g}°, grazing {e.view.grazing_deg:g}°)" for e in entries)
    return [
        f"{one} and {other} are one and the same picture{_more(pairs)}, so the file or the angles of one are wrong: "
        "correct them, or remove one"
    ]


def _more(pairs: Sequence[tuple[int, int]]) -> str:
    return f" (and {counted(len(pairs) - 1, 'other pair')})" if len(pairs) > 1 else ""
