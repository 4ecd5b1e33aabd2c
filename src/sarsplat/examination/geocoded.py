"""Whether images lie on a map (geocoded, north up) rather than in azimuth and range.

On a map the scene stays where it is as the azimuth changes, and what the look makes of it turns: shadow, and the edge
that faces the radar. In azimuth and range it is the other way round. Either sign alone has its exceptions (a target
without any azimuth stays put in azimuth and range, too).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates

from sarsplat.examination.neighbouring_views import match, neighbours, reach
from sarsplat.examination.significance import Evidence, SideEvidence
from sarsplat.geometry import ImageGrid, View


@dataclass(frozen=True)
class OnMap:
    """What images say of lying on a map."""

    stays: Evidence
    """By how much neighbouring images match better as they are than turned by their azimuths, in either sense."""
    turned: SideEvidence
    """Darkness beyond what is bright, by side that is near, after images were turned by their azimuths."""
    shadow: SideEvidence
    """The same as they are."""


def map_levels(
    levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View], grid: ImageGrid
) -> Float64[np.ndarray, "v m m"]:
    """Images on a map, north up, as they would be in azimuth and ground range, if x pointed east: cut to what all show."""
    half = (min(grid.rows, grid.columns) - 1) / 2
    side = int(half * np.sqrt(0.5)) * 2 + 1
    across, away = np.meshgrid(*2 * [np.arange(side) - (side - 1) / 2])
    made = []
    for level, view in zip(levels, views, strict=True):
        azimuth, away_axis = view.look.frame[0, :2], view.look.ahead
        x, y = (azimuth[k] * across + away_axis[k] * away for k in (0, 1))
        rows, columns = level.shape
        made.append(map_coordinates(level, [(rows - 1) / 2 - y, (columns - 1) / 2 + x], order=1))
    return np.array(made)
