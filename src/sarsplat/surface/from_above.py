"""Surface from above: height and γ⁰ of its uppermost layer in each pixel of a map."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Real
from scipy.ndimage import distance_transform_edt, map_coordinates

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.progress import stage
from sarsplat.renderer import attenuate, project
from sarsplat.surface.points import imaged, spread

_STEEP = 0.3  # upward part of a normal below which a point belongs to a wall, which has no area from above
HIDDEN = 0.5  # two-way loss above which ground is hidden from a view


def uppermost(
    pixel: Int64[np.ndarray, "p 2"],
    shape: tuple[int, int],
    heights: Real[np.ndarray, " p"],
    upward: Real[np.ndarray, " p"],
    values: Real[np.ndarray, " p"] | None,
    gap_m: float,
) -> Float64[np.ndarray, "rows columns"]:
    """Mean height (or other value) of each pixel's uppermost layer; NaN in pixels without points.

    The layer ends at the first vertical gap of `gap_m`. Points are weighted by the upward part of their normals; walls
    count only in pixels without other points.
    """
    rows, columns = shape
    inside = ((pixel >= 0) & (pixel < shape)).all(axis=1)
    flat = pixel[inside, 0] * columns + pixel[inside, 1]
    heights, upward = heights[inside], upward[inside]
    values = heights if values is None else values[inside]
    order = np.lexsort((-heights, flat))
    flat, heights = flat[order], heights[order]
    first = np.append(True, flat[1:] != flat[:-1])[: len(flat)]
    falls = np.append(False, heights[:-1] - heights[1:] > gap_m)[: len(flat)] & ~first
    falls = np.cumsum(falls)
    top = falls == np.maximum.accumulate(np.where(first, falls, 0))
    flat, upward, values = flat[top], upward[order][top], values[order][top]
    weight = np.where(upward >= _STEEP, upward, 0)
    lone = np.bincount(flat, weight, rows * columns)[flat] == 0
    weight = np.where(lone, 1.0, weight)
    total = np.bincount(flat, weight, rows * columns)
    with np.errstate(invalid="ignore"):
        return (np.bincount(flat, weight * values, rows * columns) / total).reshape(shape)


def without_holes(values: Float64[np.ndarray, "rows columns"], reach: float) -> Float64[np.ndarray, "rows columns"]:
    """Fill unknown pixels inside the closing (radius `reach`, pixels) of the known ones with the nearest value."""
    known, margin = np.isfinite(values), math.ceil(reach) + 1  # pixels outside of the map are unknown
    distance = distance_transform_edt(~np.pad(known, margin))
    within = distance_transform_edt(distance <= reach) > reach
    holes = within[margin:-margin, margin:-margin] & ~known
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = values.copy()
    filled[holes] = values[tuple(index[holes] for index in nearest)]
    return filled


@torch.no_grad()
def ground_seen(
    target: Gaussians, places: Float64[np.ndarray, "p 3"], views: Sequence[View], grid: ImageGrid
) -> Bool[np.ndarray, " p"]:
    """Mask of the places on the ground, m, that are inside an image and not hidden by the target there.

    At most 96 views are used, evenly chosen.
    """
    visible, rays = np.zeros(len(places), bool), RayGrid.for_image(grid)
    chosen = spread(views)
    with stage("surface: ground", len(chosen)) as shown:
        for view in chosen:
            index = np.flatnonzero(~visible & imaged(places, view, grid))
            azimuth, elevation, _ = view.look.frame @ places[index].T
            visible[index] = transmittance_at(target, view, grid, rays, azimuth, elevation) > 1 - HIDDEN
            shown.advance(1)
    return visible


def transmittance_at(
    gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, *place: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    """Two-way transmittance of Gaussians on rays at azimuths and elevations (`place`), m; 1 beyond the rays."""
    projection = project(gaussians, [view], grid, rays=rays)
    (ray_map,) = attenuate(projection, rays, first_return_depth=1.0).ray_maps or ()  # any depth asks for ray maps
    column, row = ((at - first) / step for at, first, step in zip(place, ray_map.origin, rays.spacing_m, strict=True))
    return map_coordinates(ray_map.transmittance.double().cpu().numpy(), [row, column], order=1, cval=1.0)
