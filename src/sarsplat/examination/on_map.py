"""Whether images lie on a map (geocoded, north up) rather than in azimuth and range.

On a map the scene stays where it is as the azimuth changes, and what the look makes of it turns: shadow, and the edge
that faces the radar. In azimuth and range it is the other way round. That the scene stays is not enough, for a target
that is the same from all sides stays in azimuth and range, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Real
from scipy.ndimage import map_coordinates

from sarsplat.examination.orientation import (
    LEAST_EDGE,
    LEAST_SENSE,
    LEAST_SHADOW_DB,
    Orientation,
    edge_sides,
    shadow_sides,
)
from sarsplat.examination.significance import Evidence, SideEvidence
from sarsplat.geometry import ImageGrid, View
from sarsplat.regions.outlines import levels_db, outline


@dataclass(frozen=True)
class OnMap:
    """What images say of lying on a map; near range as they are, and after turning each by its azimuth in one sense."""

    stays: Evidence
    """By how much neighbouring images match better as they are than turned, in whichever sense."""
    shadow: SideEvidence
    turned_shadow: SideEvidence
    edge: SideEvidence
    turned_edge: SideEvidence

    @property
    def certain(self) -> bool:
        """Whether they lie on a map: shadow, which does not tell near range as they are, tells it after turning; or the
        scene stays where it is, and shadow, or without ground its bright edge, is clearer after turning.
        """
        if self.shadow.side(LEAST_SHADOW_DB) is not None:
            return False
        if self.turned_shadow.side(LEAST_SHADOW_DB) is not None and self.shadow_gain > LEAST_SHADOW_DB:
            return True
        return self.stays.supports(LEAST_SENSE) and (
            self.shadow_gain > LEAST_SHADOW_DB
            if self.shadow.count
            else self.turned_edge.side(LEAST_EDGE) is not None and self.edge.side(LEAST_EDGE) is None
        )

    @property
    def shadow_gain(self) -> float:
        """By how much it is darker beyond what is bright after turning, dB; 0 if there are too few images."""
        return float(self.turned_shadow.mean.max() - self.shadow.mean.max())

    def __str__(self) -> str:
        """What speaks for a map."""
        signs = []
        if self.stays.supports(LEAST_SENSE):
            signs.append(
                f"images of neighbouring azimuths match better as they are than turned (correlation higher by "
                f"{self.stays.mean:.2f})"
            )
        if self.shadow.count and self.shadow_gain > LEAST_SHADOW_DB:
            signs.append(
                f"shadows turn with the azimuths ({self.shadow_gain:.1f} dB darker on one side after turning back)"
            )
        elif self.turned_edge.side(LEAST_EDGE) is not None:
            signs.append("the target's bright edge turns with the azimuths")
        return ", and ".join(signs)


def on_map(
    power: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    seen: Orientation,
    *,
    ground: bool,
) -> OnMap:
    """What images (β⁰, linear power) say of lying on a map, given what they say of their orientation."""
    levels = levels_db(power, grid, ground)
    senses = []
    for sense in (1, -1):
        turned = _turned(levels, [replace(view, azimuth_deg=sense * view.azimuth_deg) for view in views])
        edge = edge_sides(turned, [outline(level) for level in turned])
        senses.append((shadow_sides(turned if ground else turned[:0], views), edge))
    shadow, edge = max(senses, key=lambda sides: max(sides[not ground].mean))
    return OnMap(seen.stays, seen.shadow, shadow, seen.edge, edge)


def _turned(levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View]) -> Float64[np.ndarray, "v m m"]:
    """Images of a map whose columns run along x with the radar on top, as far as all of them show it.

    If columns run otherwise, the radar is at one other side of all of them.
    """
    half = (min(levels.shape[1:]) - 1) / 2
    places = np.arange(2 * math.floor(half * math.sqrt(0.5)) + 1) - math.floor(half * math.sqrt(0.5))
    right, down = np.meshgrid(places, places)
    made = []
    for level, view in zip(levels, views, strict=True):
        across, ahead = view.look.frame[0, :2] / np.hypot(*view.look.frame[0, :2]), view.look.ahead
        x, y = across[:, None, None] * right + ahead[:, None, None] * down
        rows, columns = level.shape
        made.append(map_coordinates(level, [(rows - 1) / 2 - y, (columns - 1) / 2 + x], order=1))
    return np.array(made)
