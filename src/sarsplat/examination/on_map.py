"""Recognition of images that lie on a map (geocoded, north up) rather than in azimuth and range.

On a map the scene keeps its place as the azimuth changes, while shadow and the bright edge facing the radar turn; in
azimuth and range it is the reverse. The place of the scene alone proves nothing: a rotationally symmetric target keeps
it in azimuth and range, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Real
from scipy.ndimage import map_coordinates

from sarsplat.examination.orientation import (
    MIN_EDGE,
    MIN_SENSE,
    MIN_SHADOW_DB,
    Orientation,
    edge_sides,
    shadow_sides,
)
from sarsplat.examination.significance import Evidence, SideEvidence
from sarsplat.geometry import ImageGrid, View
from sarsplat.regions.outlines import levels_db, outline


@dataclass(frozen=True)
class OnMap:
    """Evidence that images are geocoded; `turned_…` is evidence after rotating each image by its azimuth."""

    stays: Evidence
    """Correlation of neighbouring images without rotation, less that with the better sense of rotation."""
    shadow: SideEvidence
    turned_shadow: SideEvidence
    edge: SideEvidence
    turned_edge: SideEvidence

    @property
    def certain(self) -> bool:
        """True if only turned images have a shadow side; or the scene keeps its place, and turning makes the shadow, or
        without ground the bright edge, clearer.
        """
        if self.shadow.side(MIN_SHADOW_DB) is not None:
            return False
        if self.turned_shadow.side(MIN_SHADOW_DB) is not None and self.shadow_gain > MIN_SHADOW_DB:
            return True
        return self.stays.supports(MIN_SENSE) and (
            self.shadow_gain > MIN_SHADOW_DB
            if self.shadow.count
            else self.turned_edge.side(MIN_EDGE) is not None and self.edge.side(MIN_EDGE) is None
        )

    @property
    def shadow_gain(self) -> float:
        """Increase by turning of the darkness behind bright pixels, dB; 0 if there are too few images."""
        return float(self.turned_shadow.mean.max() - self.shadow.mean.max())

    def __str__(self) -> str:
        """Signs of a map, for messages."""
        signs = []
        if self.stays.supports(MIN_SENSE):
            signs.append(
                f"images of neighbouring azimuths match better as they are than turned (correlation higher by "
                f"{self.stays.mean:.2f})"
            )
        if self.shadow.count and self.shadow_gain > MIN_SHADOW_DB:
            signs.append(
                f"shadows turn with the azimuths ({self.shadow_gain:.1f} dB darker on one side after turning back)"
            )
        elif self.turned_edge.side(MIN_EDGE) is not None:
            signs.append("the target's bright edge turns with the azimuths")
        return ", and ".join(signs)


def on_map(
    power: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    estimate: Orientation,
    *,
    ground: bool,
) -> OnMap:
    """Collect evidence that images (β⁰, linear power) are geocoded, given their orientation."""
    levels = levels_db(power, grid, ground)
    senses = []
    for sense in (1, -1):
        turned = _rotated(levels, [replace(view, azimuth_deg=sense * view.azimuth_deg) for view in views])
        edge = edge_sides(turned, [outline(level) for level in turned])
        senses.append((shadow_sides(turned if ground else turned[:0], views), edge))
    shadow, edge = max(senses, key=lambda sides: max(sides[not ground].mean))
    return OnMap(estimate.stays, estimate.shadow, shadow, estimate.edge, edge)


def _rotated(levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View]) -> Float64[np.ndarray, "v m m"]:
    """Rotate map images whose columns run along x to have the radar on top, cropped to the square that all show.

    If columns run otherwise, the radar is at another side, the same in all images.
    """
    half = (min(levels.shape[1:]) - 1) / 2
    offsets = np.arange(2 * math.floor(half * math.sqrt(0.5)) + 1) - math.floor(half * math.sqrt(0.5))
    right, down = np.meshgrid(offsets, offsets)
    rotated = []
    for level, view in zip(levels, views, strict=True):
        across, ahead = view.look.frame[0, :2] / np.hypot(*view.look.frame[0, :2]), view.look.ahead
        x, y = across[:, None, None] * right + ahead[:, None, None] * down
        rows, columns = level.shape
        rotated.append(map_coordinates(level, [(rows - 1) / 2 - y, (columns - 1) / 2 + x], order=1))
    return np.array(rotated)
