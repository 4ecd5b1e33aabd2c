"""Orientation of images, estimated from the images: near side and sense of the azimuths, or whether they lie on a map.

There are eight orientations: four near sides, mirrored or not. Mirrored images with azimuths in the opposite sense show
a mirrored target, which no image can reveal: a wrong sense of the azimuths and a mirror are one finding.

On a map (geocoded, north up) the scene keeps its place as the azimuth changes, while shadow and the bright edge facing
the radar turn; in azimuth and range it is the reverse. The place of the scene alone proves nothing: a rotationally
symmetric target keeps it in azimuth and range, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float64, Real
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import map_coordinates

from sarsplat.data.image import in_blocks
from sarsplat.data.orientation import SIDES, oriented
from sarsplat.examination.neighbouring_views import (
    common_half_side_m,
    match,
    neighbours,
    steeper_neighbours,
    stretch_bias,
)
from sarsplat.examination.significance import CHANCE, Evidence, SideEvidence
from sarsplat.geometry import ImageGrid, View
from sarsplat.names import Side
from sarsplat.regions.outlines import Outline, levels_db, outline

_MIN_SHADOW_DB = 0.2
_MIN_EDGE = 0.05
_MIN_LAYOVER = 0.005
_MIN_SENSE = 0.01
_MIN_GRAZING = 0.01
"""Minimum mean differences of decibels, skewness and correlation that count as evidence, for any number of images."""

_BRIGHT_DB, _BRIGHTEST_DB = 3.0, 23.0
"""Levels above the ground between which the weight of bright pixels rises, dB: it is 0 for speckle."""

_DARKEST_DB = -10.0  # level relative to the ground at which the darkness of shadow is clipped, dB
_PIXELS = 256  # maximum pixels per side in the search for shadow; larger images are averaged


@dataclass(frozen=True)
class Orientation:
    """Estimated orientation of images, with its evidence."""

    near: Side | None
    """Side near the radar; None if undetermined."""
    shadow: SideEvidence
    """Darkness behind bright pixels, dB below the ground; no images if they show no ground."""
    edge: SideEvidence
    """Skewness of the target's amplitude away from each side."""
    layover: SideEvidence
    """Correlation of neighbouring images with bright pixels displaced to each side."""
    correlation: dict[Side, tuple[float, float]]
    """Near side → mean correlation of neighbouring images, with azimuths as given and in the opposite sense; empty
    without neighbours."""
    sense: Evidence
    """Correlation with azimuths as given, less that in the opposite sense."""
    grazing: Evidence
    """Correlation with grazing angles as given, less that with them as incidence angles."""
    steeper: Evidence
    """`grazing` plus `stretch_bias`: negative only for incidence angles."""
    stays: Evidence
    """Correlation of neighbouring images without rotation, less that with the better sense of rotation."""

    @property
    def by_shadow(self) -> bool:
        """True if shadow alone determines the near side."""
        return self.shadow.side(_MIN_SHADOW_DB) is not None

    @property
    def opposite(self) -> bool | None:
        """True if azimuths have the opposite sense or images are mirrored; None if undetermined."""
        if self.sense.supports(_MIN_SENSE):
            return False
        return True if self.sense.against(_MIN_SENSE) else None

    @property
    def incidence(self) -> bool:
        """True if grazing angles seem to be incidence angles."""
        return self.near is not None and self.steeper.against(_MIN_GRAZING)


def orientation(
    power: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    *,
    ground: bool,
    centred: bool = False,
) -> Orientation:
    """Estimate the orientation of images (β⁰, linear power).

    With `centred`, the world's origin surely is where the grid has it, so that layover alone determines the near side.
    """
    levels = levels_db(power, grid, ground)
    shadow = shadow_sides(levels if ground else levels[:0], views)
    edge = edge_sides(levels, [outline(level) for level in levels])
    sideways = turned_grid(grid, "right")
    frames = [(levels, grid), (levels_db(oriented(power, "right"), sideways, ground), sideways)]
    bright = [np.maximum(shown, 0.0) for shown, _ in frames]
    pairs = neighbours(views) if common_half_side_m(grid) > 0 else []
    senses = [[match(bright[k], views, frames[k][1], pairs, sense=sense) for sense in (1, -1)] for k in (0, 1)]
    best = [[matches.best() for matches in both] for both in senses]  # by axis of range and sense
    better = [int(np.argmax([values.sum() for values in both])) for both in best]
    displaced = [senses[k][better[k]].displaced(away) for away in (-1, 1) for k in (0, 1)]  # in the order of SIDES
    layover = SideEvidence(np.stack(displaced, axis=1))
    near = _near(shadow, edge, layover, centred)
    turned = [best[k][better[k]] for k in (0, 1)]
    likelier = int(turned[1].sum() > turned[0].sum())
    axis = SIDES.index(near) % 2 if near else likelier
    all_pairs = [*pairs, *(steeper_neighbours(views) if pairs else [])]
    # with as many pixels by grazing as by incidence angles: more ground around a target lowers the correlation
    readings = views, [replace(view, grazing_deg=view.incidence_deg) for view in views]
    scales = [float(np.mean([view.look.slant_range(1.0) for view in seen])) for seen in readings]
    compared = partial(match, bright[axis], grid=frames[axis][1], pairs=all_pairs, sense=(1, -1)[better[axis]])
    given, swapped = (
        compared(seen, within=math.sqrt(min(scales) / scale)).best()
        for seen, scale in zip(readings, scales, strict=True)
    )
    return Orientation(
        near,
        shadow,
        edge,
        layover,
        {side: (float(best[k % 2][0].mean()), float(best[k % 2][1].mean())) for k, side in enumerate(SIDES) if pairs},
        Evidence(best[axis][0] - best[axis][1]),
        Evidence(given - swapped),
        Evidence(given - swapped + stretch_bias(views, all_pairs, np.maximum(given, swapped))),
        Evidence(match(bright[0], views, grid, pairs, sense=0).best() - turned[likelier]),
    )


def turned_grid(grid: ImageGrid, near: Side) -> ImageGrid:
    """Return the grid after turning side `near` to the top; spacings stay those of azimuth and range."""
    return grid if SIDES.index(near) % 2 == 0 else replace(grid, rows=grid.columns, columns=grid.rows)


def _near(shadow: SideEvidence, edge: SideEvidence, layover: SideEvidence, centred: bool) -> Side | None:
    """Return the near side by shadow or, without a result, by layover and bright edge together.

    Layover alone is ambiguous with targets away from the middle of their images.
    """
    certain = shadow.side(_MIN_SHADOW_DB) or (layover.side(_MIN_LAYOVER) if centred else None)
    if certain is not None:
        return certain
    significance = math.sqrt(CHANCE)  # of each of the two
    by_layover = layover.side(_MIN_LAYOVER, significance)
    darkest = SIDES[int(shadow.mean.argmax())] if shadow.count else by_layover
    return by_layover if by_layover == edge.side(_MIN_EDGE, significance) == darkest else None


def shadow_sides(levels: Float64[np.ndarray, "v rows columns"], views: Sequence[View]) -> SideEvidence:
    """Measure for each near side how much darker than the ground (`levels`, dB above it) it is behind the target, dB.

    "Behind" is the quadrant around the direction away from that side, to half the shorter side of the images. All
    distances have the same weight; bright pixels are weighted by their decibels.
    """
    step = min(math.ceil(max(levels.shape[1:]) / _PIXELS), *levels.shape[1:])
    rows, columns = (pixels // step for pixels in levels.shape[1:])
    padded = next_fast_len(2 * rows), next_fast_len(2 * columns)
    down, right = np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in padded), indexing="ij")
    distance = np.hypot(down, right)
    weight = np.where((distance > 0) & (distance <= min(rows, columns) / 2), 1 / np.maximum(distance, 1.0), 0.0)
    beyond = (down > abs(right), -right > abs(down), -down > abs(right), right > abs(down))  # of top, right …
    quadrants = [rfft2(weight * mask) for mask in beyond]
    darkness, directions = [], []
    for level, view in zip(levels, views, strict=False):
        weights = np.clip(level - _BRIGHT_DB, 0.0, _BRIGHTEST_DB - _BRIGHT_DB), np.clip(-level, 0.0, -_DARKEST_DB)
        coarse, dark = (in_blocks(image, step).mean(axis=(1, 3)) for image in weights)
        bright = rfft2(coarse, padded)
        reached = [irfft2(bright * quadrant, padded)[:rows, :columns] for quadrant in quadrants]
        if bright[0, 0].real > 0 and min(share.sum() for share in reached) > 0:
            darkness.append([float((share * dark).sum() / share.sum()) for share in reached])
            directions.append(view.look.ahead)
    return SideEvidence(np.array(darkness).reshape(-1, 4), np.array(directions).reshape(-1, 2))


def edge_sides(levels: Float64[np.ndarray, "v rows columns"], outlines: Sequence[Outline]) -> SideEvidence:
    """Measure the skewness of the target's amplitude away from each side; `levels` are dB above ground or noise floor.

    It is positive for a bright edge on that side with a long tail behind it.
    """
    targets = np.array([outline.target for outline in outlines])
    amplitude = np.where(targets, 10 ** (levels / 20), 0.0)
    amplitude = amplitude[amplitude.any(axis=(1, 2))]
    down, right = _skewness(amplitude.sum(axis=2)), _skewness(amplitude.sum(axis=1))
    return SideEvidence(np.stack([down, -right, -down, right], axis=1))


def _skewness(profiles: Float64[np.ndarray, "v n"]) -> Float64[np.ndarray, " v"]:
    position = np.arange(profiles.shape[1], dtype=float)
    share = profiles / profiles.sum(axis=1, keepdims=True)
    offset = position - (share @ position)[:, None]
    spread = np.maximum((share * offset**2).sum(axis=1), 1e-9)
    return (share * offset**3).sum(axis=1) / spread**1.5


def signs_of_map(
    power: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    estimate: Orientation,
    *,
    ground: bool,
) -> str:
    """Describe the signs that images (β⁰, linear power) without a shadow side are geocoded; empty if they seem not.

    Either only images that are turned by their azimuths have a shadow side; or the scene keeps its place, and turning
    makes the shadow, or without ground the bright edge, clearer.
    """
    levels = levels_db(power, grid, ground)
    senses = []
    for sense in (1, -1):
        turned = _rotated(levels, [replace(view, azimuth_deg=sense * view.azimuth_deg) for view in views])
        edge = edge_sides(turned, [outline(level) for level in turned])
        senses.append((shadow_sides(turned if ground else turned[:0], views), edge))
    shadow, edge = max(senses, key=lambda sides: max(sides[not ground].mean))
    gain_db = float(shadow.mean.max() - estimate.shadow.mean.max())  # 0 if there are too few images
    clearer, has_edge = gain_db > _MIN_SHADOW_DB, edge.side(_MIN_EDGE) is not None
    stays = estimate.stays.supports(_MIN_SENSE)
    turns = clearer if estimate.shadow.count else has_edge and estimate.edge.side(_MIN_EDGE) is None
    if not (stays and turns) and not (clearer and shadow.side(_MIN_SHADOW_DB) is not None):
        return ""
    signs = []
    if stays:
        higher = f"correlation higher by {estimate.stays.mean:.2f}"
        signs.append(f"images of neighbouring azimuths match better as they are than turned ({higher})")
    if estimate.shadow.count and clearer:
        signs.append(f"shadows turn with the azimuths ({gain_db:.1f} dB darker on one side after turning back)")
    elif has_edge:
        signs.append("the target's bright edge turns with the azimuths")
    return ", and ".join(signs)


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
