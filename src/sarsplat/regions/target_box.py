"""Bounding box of the target: sides from places brighter than the ground, height from the shadow."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import affine_transform, label, maximum

from sarsplat.data.image import in_blocks
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.regions.image_levels import above_ground_db, seen_by_all, typical

_SURE_DB = 3.0  # level above the ground that speckle does not reach, dB
_PROBABLE = 2.0  # standard deviations above the ground of places that belong to a target if connected to a sure one
_FAINTEST_DB = 1.0  # minimum level of such places above the ground, dB: without noise, responses reach far
_GLINT_DB = 12.0  # level below the target's bright part that the response of glints may have, dB
_BRIGHT_PART = 0.9  # quantile of the target's levels at which its bright part begins
_LARGE_PART = 0.2  # minimum weight of a connected part, relative to the largest: few views show a target in pieces
_DARKEST_DB = -3.0  # level below the ground at which shadow is clipped in the search for the target, dB

_SHADOW_DB = (-6.0, 3.0)
"""Limits of levels in the search for shadow, dB: darker pixels are clipped, brighter ones are left out."""

_DARK_DB = (-4.5, -2.5)
"""Mean level of the middle of a shadow, dB: below the first it is certain, above the second there is no shadow."""

_SURELY = 6.0  # standard deviations of the ground for a detection in between: it is the extreme of many places
_KNOWN = 0.6  # minimum share of the images that show a place's possible shadow

_UPRIGHT = 4.0
"""Inverse of the displacement along an axis, per metre of height, at which a view counts half for that axis."""

_TIP = 1.1  # height of the box, relative to the highest visible shadow: a narrow top throws none
_HEIGHT = 0.65  # height of the box without shadow, relative to its narrower side
_SIDE = 256  # maximum number of places along a side of the scene; more pixels than that are averaged
_PLACES = 128  # number of places along a side of the box, and of heights up to its width, in the search for shadow
_VIEWS = 48  # maximum number of images in the search for shadow, evenly chosen


def target_box(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Return the corners of the target's box, from the mean level over the images at each place of the ground.

    Objects are displaced in range, never across: views across an axis weigh most for the extent along it. The box holds
    every object that stands out (`StandingOut`). Its height is the greatest at which the shadow of some place is dark
    on average over the views that show it and in which nothing bright hides it. Images are β⁰, linear power, and show
    the ground around the target; their gains may differ. One that does not show the world's origin is refused.

    The box (m, world frame) is a cell wider and higher than the target; z from 0, to two thirds of the narrower side if
    there is no shadow. Where nothing stands out, it is the middle half of the scene.
    """
    level_db, grid, axis = _levels(power, views, grid)
    half = float(axis[-1])
    bright_db = np.maximum(level_db, _DARKEST_DB)
    extents = []
    for i in range(2):
        above_db = _on_the_ground(bright_db, views, grid, axis, _weights_across(views, i))
        extent = _extent(above_db, axis, i)
        if extent is None:
            return np.array([-half / 2, -half / 2, 0.0]), np.array([half / 2, half / 2, _HEIGHT * half])
        extents.append(extent)
    low, high = np.array(extents).T + np.array([[-grid.cell_m], [grid.cell_m]])
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int))
    height = _height(level_db[chosen], [views[k] for k in chosen], grid, axis, low, high)
    return np.array([*low, 0.0]), np.array([*high, height])


@dataclass(frozen=True)
class StandingOut:
    """Places [y, x] brighter than the ground, by means over the images, within the ground that all images show."""

    axis: Float64[np.ndarray, " side"]
    """Coordinates of the places, along x and y alike, m."""
    above_db: Float64[np.ndarray, "side side"]
    """Decibels above the ground of sure places, 0 elsewhere."""
    objects: tuple[Bool[np.ndarray, "side side"], ...]
    """Masks of connected objects, of any size (`_objects`)."""


def standing_out(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid
) -> StandingOut:
    """Find places brighter than the ground; arguments and errors as for `target_box`."""
    level_db, grid, axis = _levels(power, views, grid)
    above_db = _on_the_ground(np.maximum(level_db, _DARKEST_DB), views, grid, axis, np.ones(len(views)))
    part = _parts(above_db)
    objects = tuple(part == k for k in _objects(above_db, part))
    return StandingOut(axis, np.where(above_db > _SURE_DB, above_db, 0.0), objects)


def _objects(above_db: Float64[np.ndarray, "side side"], part: Int[np.ndarray, "side side"]) -> Int[np.ndarray, " k"]:
    """Numbers of the parts that are objects: peaks are no noise, and at least half the target's bright level, dB."""
    if not part.any():
        return np.empty(0, int)
    peaks_db = maximum(np.where(part > 0, above_db, -np.inf), part, np.arange(1, part.max() + 1))
    return 1 + np.flatnonzero(peaks_db > max(_SURE_DB, _SURELY * typical(above_db)[1], _bright_db(above_db) / 2))


def _levels(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid
) -> tuple[Float64[np.ndarray, "v rows columns"], ImageGrid, Float64[np.ndarray, " side"]]:
    """Decibels above the ground, averaged to fewer pixels if there are many; their grid; axis of places, m."""
    half = seen_by_all(views, grid)
    if half <= 0:
        raise SarsplatError(
            f"the images, with their middle at {grid.center_m} m, do not show the world's origin, around which the "
            "target is looked for; give `target_box`, or images that show the origin"
        )
    if (factor := math.ceil(4 * half / grid.cell_m / _SIDE)) > 1:
        grid, power = grid.multilooked(factor), in_blocks(power, factor).mean(axis=(2, 4))
    axis = np.linspace(-half, half, 2 * math.ceil(2 * half / grid.cell_m) + 1)
    return above_ground_db(power, grid), grid, axis


def _extent(
    above_db: Float64[np.ndarray, "side side"], axis: Float64[np.ndarray, " side"], i: int
) -> list[float] | None:
    """First and last coordinate of the target along axis i, m; None without target."""
    part = _parts(above_db)
    weight = np.bincount(part.ravel(), ((above_db > _SURE_DB) * above_db).ravel())
    weight[0] = 0  # background
    if not weight.any():
        return None
    is_target = weight >= _LARGE_PART * weight.max()
    is_target[_objects(above_db, part)] = True
    index = np.nonzero(is_target[part])[1 - i]
    return [float(axis[index.min()]), float(axis[index.max()])]


def _parts(above_db: Float64[np.ndarray, "side side"]) -> Int[np.ndarray, "side side"]:
    """Label the connected parts that are probably brighter than the ground, from 1; all is 0 if none is surely."""
    if not (above_db > _SURE_DB).any():
        return np.zeros(above_db.shape, int)
    threshold_db = max(_FAINTEST_DB, _PROBABLE * typical(above_db)[1], _bright_db(above_db) - _GLINT_DB)
    return label(above_db > threshold_db)[0]


def _bright_db(above_db: Float64[np.ndarray, "side side"]) -> float:
    """Level of the target's bright part above the ground, dB."""
    return float(np.quantile(above_db[above_db > _SURE_DB], _BRIGHT_PART))


def _height(
    level_db: Float[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    axis: Float64[np.ndarray, " side"],
    low: Float64[np.ndarray, " 2"],
    high: Float64[np.ndarray, " 2"],
) -> float:
    """Height of the box, m: a little above the highest place that casts a shadow."""
    tangents = np.array([view.look.slope for view in views])
    weights = tangents**-2.0  # an error along the ground is one in height times the tangent
    clipped_db = np.clip(level_db, *_SHADOW_DB)
    noise_db = typical(_on_the_ground(clipped_db, views, grid, axis, weights))[1]
    clipped_db[level_db > _SHADOW_DB[1]] = np.nan
    dark = max(_DARK_DB[0], min(_DARK_DB[1], -_SURELY * noise_db))
    narrow, wide = (float(pick(high - low)) for pick in (np.min, np.max))
    step = max(grid.cell_m / 2, wide / _PLACES)
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    top = darkest = 0.0
    for z in np.arange(0.0, 2 * axis[-1], step):  # no higher than the scene is wide
        mean, seen = _mean(clipped_db, views, grid, x, y, float(z), weights)
        known = seen >= _KNOWN
        if not known.any():
            if top > z - 1.5 * step:  # higher shadows are outside of the images
                top = max(top, _HEIGHT * narrow)
            break
        depth = float((mean * np.sqrt(seen))[known].min())  # fewer images, more noise
        darkest = min(darkest, depth)
        if depth < dark:
            top = float(z)
        elif z > narrow:  # lower shadows may be hidden by the target's own brightness
            break
    if darkest > _DARK_DB[0]:
        return _HEIGHT * narrow
    # places above a wide roof's middle are in shadow from all sides, too, and the higher, the steeper the views
    return _TIP * max(min(top, narrow), top - narrow / 2 * float(tangents.min())) + max(grid.cell_m, 2 * step)


def _on_the_ground(
    level_db: Float64[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    axis: Float64[np.ndarray, " side"],
    weights: Float64[np.ndarray, " v"],
) -> Float64[np.ndarray, "side side"]:
    """Weighted mean over the images at each place on the ground; NaN if not all show it."""
    mean, seen = _mean(level_db, views, grid, axis, axis, 0.0, weights)
    return np.where(seen < 1 - 1e-9, np.nan, mean)


def _weights_across(views: Sequence[View], i: int) -> Float64[np.ndarray, " v"]:
    """Weight of each view for the extent along axis i: views across that axis count most."""
    leans = np.array([view.look.displaced[i] for view in views])  # along the axis, per metre of height
    return 1 / (1 + (_UPRIGHT * leans) ** 2)


def _mean(
    level_db: Float64[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    x: Float64[np.ndarray, " nx"],
    y: Float64[np.ndarray, " ny"],
    z: float,
    weights: Float64[np.ndarray, " v"],
) -> tuple[Float64[np.ndarray, "ny nx"], Float64[np.ndarray, "ny nx"]]:
    """Weighted mean over the images at the shadows of places (x, y, z) on the ground, and the share that show these.

    A place at z = 0 is its own shadow. The mean is 0 if no image shows the shadow.
    """
    pixel_m, first_m = np.array(grid.spacing_m[::-1]), np.array([grid.range_m[0], grid.azimuth_m[0]])
    total, weight_seen, seen = np.zeros((3, len(y), len(x)))
    for image, view, weight in zip(level_db, views, weights, strict=True):
        frame = view.look.gradients[[1, 0]]  # away and across, as rows and columns are
        # shadow of the first place on the ground
        first = frame @ (x[0], y[0], z) + (z / view.look.sine, 0.0)
        step = frame[:, [1, 0]] * (y[1] - y[0], x[1] - x[0]) / pixel_m[:, None]
        level = affine_transform(
            image, step, (first - first_m) / pixel_m, total.shape, order=1, mode="constant", cval=np.nan
        )
        shown = np.isfinite(level)
        total += weight * np.where(shown, level, 0.0)
        weight_seen += weight * shown
        seen += shown / len(views)
    return np.divide(total, weight_seen, out=np.zeros_like(total), where=weight_seen > 0), seen
