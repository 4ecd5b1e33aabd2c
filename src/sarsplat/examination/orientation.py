"""Orientation of images, from the images: which side is near range, and which way azimuths run.

Eight orientations are told apart: each of the four sides may be near, and the images mirrored or not. Mirrored images
with azimuths in the opposite sense are those of a mirrored target, and no image shows a target to be mirrored: so a
wrong sense of the azimuths and a mirror are one finding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Real
from scipy.fft import irfft2, next_fast_len, rfft2

from sarsplat.data.image import in_blocks
from sarsplat.data.orientation import SIDES, oriented
from sarsplat.examination.neighbouring_views import (
    as_grazing_and_incidence,
    less_stretched_anyway,
    match,
    neighbours,
    reach,
    steeper_neighbours,
)
from sarsplat.examination.significance import CHANCE, Evidence, SideEvidence
from sarsplat.geometry import ImageGrid, View
from sarsplat.names import Side
from sarsplat.regions.outlines import Outline, levels_db, outline

LEAST_SHADOW_DB = 0.2
LEAST_EDGE = 0.05
_LEAST_LAYOVER = 0.005
LEAST_SENSE = 0.01
_LEAST_GRAZING = 0.01
"""Differences of decibels, skewness and correlation below these are no evidence, however many images show them."""

_BRIGHT_DB, _BRIGHTEST_DB = 3.0, 23.0
"""Above the ground: from where on something stands out from speckle, and where its brightness says no more."""

_DARKEST_DB = -10.0
"""Below the ground: what is darker says no more."""

_PIXELS = 256
"""Most on a side in the search for shadow: larger images are averaged."""


@dataclass(frozen=True)
class Orientation:
    """What images say of their orientation."""

    near: Side | None
    """The side that is near the radar; None if they do not tell."""
    shadow: SideEvidence
    """Decibels by which it is darker than the ground beyond what is bright; of no images if they show no ground."""
    edge: SideEvidence
    """Skewness of the target's amplitude away from each side."""
    layover: SideEvidence
    """Correlation of neighbouring images if what is bright is displaced to that side."""
    correlation: dict[Side, tuple[float, float]]
    """Side that is near → mean correlation of neighbouring images, with azimuths as given and in the opposite sense.
    Empty if there are no such images."""
    sense: Evidence
    """By how much that is higher with azimuths as given."""
    grazing: Evidence
    """By how much it is higher with grazing angles as given than with 90° less them."""
    steeper: Evidence
    """The same, and what lengths that are less stretched are ahead by anyway."""
    stays: Evidence
    """By how much neighbouring images match better without being turned by their azimuths than in either sense."""

    @property
    def by_shadow(self) -> bool:
        """Whether shadow alone tells which side is near."""
        return self.shadow.side(LEAST_SHADOW_DB) is not None

    @property
    def opposite(self) -> bool | None:
        """Whether azimuths run the other way, or the images are mirrored; None if they do not tell."""
        if self.sense.supports(LEAST_SENSE):
            return False
        return True if self.sense.against(LEAST_SENSE) else None

    @property
    def incidence(self) -> bool:
        """Whether grazing angles seem to be incidence angles."""
        return self.near is not None and self.steeper.against(_LEAST_GRAZING)


def orientation(
    power: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    *,
    ground: bool,
    centred: bool = False,
) -> Orientation:
    """What images (β⁰, linear power) say of their orientation.

    `centred` is whether the world's origin surely lies where the grid says, so that layover alone tells which side is
    near.
    """
    levels = levels_db(power, grid, ground)
    shadow = shadow_sides(levels if ground else levels[:0], views)
    edge = edge_sides(levels, [outline(level) for level in levels])
    sideways = turned_grid(grid, "right")
    frames = [(levels, grid), (levels_db(oriented(power, "right"), sideways, ground), sideways)]
    bright = [np.maximum(shown, 0.0) for shown, _ in frames]
    pairs = neighbours(views) if reach(grid) > 0 else []
    senses = [[match(bright[k], views, frames[k][1], pairs, sense=sense) for sense in (1, -1)] for k in (0, 1)]
    best = [[matches.best() for matches in both] for both in senses]  # by axis of range and sense
    better = [int(np.argmax([values.sum() for values in both])) for both in best]
    displaced = [senses[k][better[k]].displaced(away) for away in (-1, 1) for k in (0, 1)]  # in the order of SIDES
    layover = SideEvidence(np.stack(displaced, axis=1))
    near = _near(shadow, edge, layover, centred)
    axis = SIDES.index(near) % 2 if near else int(best[1][better[1]].sum() > best[0][better[0]].sum())
    more = [*pairs, *(steeper_neighbours(views) if pairs else [])]
    given, swapped = as_grazing_and_incidence(bright[axis], views, frames[axis][1], more, (1, -1)[better[axis]])
    return Orientation(
        near,
        shadow,
        edge,
        layover,
        {side: (float(best[k % 2][0].mean()), float(best[k % 2][1].mean())) for k, side in enumerate(SIDES) if pairs},
        Evidence(best[axis][0] - best[axis][1]),
        Evidence(given - swapped),
        Evidence(given - swapped + less_stretched_anyway(views, more, np.maximum(given, swapped))),
        Evidence(match(bright[0], views, grid, pairs, sense=0).best() - _highest([*best[0], *best[1]])),
    )


def _highest(correlations: Sequence[Float64[np.ndarray, " n"]]) -> Float64[np.ndarray, " n"]:
    return correlations[int(np.argmax([values.sum() for values in correlations]))]


def turned_grid(grid: ImageGrid, near: Side) -> ImageGrid:
    """The grid of images whose side `near` is brought to the top; spacings stay those of azimuth and range."""
    return grid if SIDES.index(near) % 2 == 0 else replace(grid, rows=grid.columns, columns=grid.rows)


def _near(shadow: SideEvidence, edge: SideEvidence, layover: SideEvidence, centred: bool) -> Side | None:
    """Shadow decides; where it does not, layover and the bright edge together.

    Layover alone might be targets that do not lie in the middle of their images.
    """
    certain = shadow.side(LEAST_SHADOW_DB) or (layover.side(_LEAST_LAYOVER) if centred else None)
    if certain is not None:
        return certain
    significance = math.sqrt(CHANCE)  # of each of the two
    by_layover = layover.side(_LEAST_LAYOVER, significance)
    agree = by_layover == edge.side(LEAST_EDGE, significance) and (not shadow.count or shadow.strongest == by_layover)
    return by_layover if agree else None


def shadow_sides(levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View]) -> SideEvidence:
    """For each side as near range: how much darker than the ground it is behind the bright target, dB.

    Beyond is the quadrant around the direction away from that side, as far as half the shorter side of the images. All
    distances count the same, and bright pixels by their decibels; `levels` are decibels above the ground.
    """
    step = math.ceil(max(levels.shape[1:]) / _PIXELS)
    rows, columns = (pixels // step for pixels in levels.shape[1:])
    padded = next_fast_len(2 * rows), next_fast_len(2 * columns)
    down, right = np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in padded), indexing="ij")
    distance = np.hypot(down, right)
    weight = np.where((distance > 0) & (distance <= min(rows, columns) / 2), 1 / np.maximum(distance, 1.0), 0.0)
    beyond = (down > abs(right), -right > abs(down), -down > abs(right), right > abs(down))  # of top, right …
    quadrants = [rfft2(weight * where) for where in beyond]
    darkness, directions = [], []
    for level, view in zip(levels, views, strict=False):
        bright = rfft2(_coarse(np.clip(level - _BRIGHT_DB, 0.0, _BRIGHTEST_DB - _BRIGHT_DB), step), padded)
        dark = _coarse(np.clip(-level, 0.0, -_DARKEST_DB), step)
        reached = [irfft2(bright * quadrant, padded)[:rows, :columns] for quadrant in quadrants]
        if bright[0, 0].real > 0 and min(share.sum() for share in reached) > 0:
            darkness.append([float((share * dark).sum() / share.sum()) for share in reached])
            directions.append(view.look.ahead)
    return SideEvidence(np.array(darkness).reshape(-1, 4), np.array(directions).reshape(-1, 2))


def _coarse(image: Float64[np.ndarray, "rows columns"], step: int) -> Float64[np.ndarray, "m n"]:
    """Means of squares of pixels; what is left over at the ends is left out."""
    return in_blocks(image, step).mean(axis=(1, 3))


def edge_sides(levels: Float64[np.ndarray, "v rows columns"], outlines: Sequence[Outline]) -> SideEvidence:
    """Skewness of the target's amplitude, summed over lines along each side, away from it.

    It is positive if the target has a bright edge on that side, and a long tail beyond it; `levels` are decibels above
    the ground, or above what counts as nothing.
    """
    targets = np.array([outline.target for outline in outlines])
    amplitude = np.where(targets, 10 ** (levels / 20), 0.0)
    amplitude = amplitude[amplitude.any(axis=(1, 2))]
    down, right = _skewness(amplitude.sum(axis=2)), _skewness(amplitude.sum(axis=1))
    return SideEvidence(np.stack([down, -right, -down, right], axis=1))


def _skewness(profiles: Float64[np.ndarray, "v n"]) -> Float64[np.ndarray, " v"]:
    place = np.arange(profiles.shape[1], dtype=float)
    share = profiles / profiles.sum(axis=1, keepdims=True)
    off = place - (share @ place)[:, None]
    spread = np.maximum((share * off**2).sum(axis=1), 1e-9)
    return (share * off**3).sum(axis=1) / spread**1.5
