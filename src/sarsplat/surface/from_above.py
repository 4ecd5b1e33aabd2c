"""A surface seen from above: the height and γ⁰ of its uppermost layer in each pixel of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, Real
from scipy.ndimage import map_coordinates

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.view import along_ways
from sarsplat.progress import stage
from sarsplat.renderer import attenuate, project
from sarsplat.surface.points import imaged, spread

_MOST_VIEWS = 96

_STEEP = 0.3
"""Upward part of a normal below which a point is of a wall: from above, walls have no area."""

_HIDDEN = 0.5
"""Ground is not seen from a view in which this share of its light is taken, on the way to it and back."""


@dataclass(frozen=True)
class Uppermost:
    """Means over the uppermost layer in each pixel, by the area seen from above.

    Both are float64 [rows, columns], NaN where there is none; γ⁰ is linear.
    """

    height_m: Float64[np.ndarray, "rows columns"]
    gamma0: Float64[np.ndarray, "rows columns"]


def uppermost(
    pixel: Int64[np.ndarray, "p 2"],
    shape: tuple[int, int],
    heights: Real[np.ndarray, " p"],
    upward: Real[np.ndarray, " p"],
    gamma0: Real[np.ndarray, " p"],
    gap_m: float,
) -> Uppermost:
    """What of points in pixels (row, column) is seen from above.

    The uppermost layer of a pixel ends where there is nothing for `gap_m` below. Points count by the upward part of
    their normals, and those of walls not at all, unless there are no others.
    """
    rows, columns = shape
    inside = ((pixel >= 0) & (pixel < shape)).all(axis=1)
    flat = pixel[inside, 0] * columns + pixel[inside, 1]
    heights, upward, gamma0 = heights[inside], upward[inside], gamma0[inside]
    order = np.lexsort((-heights, flat))
    flat, heights = flat[order], heights[order]
    first = np.append(True, flat[1:] != flat[:-1])[: len(flat)]
    falls = np.append(False, heights[:-1] - heights[1:] > gap_m)[: len(flat)] & ~first
    falls = np.cumsum(falls)
    top = falls == np.maximum.accumulate(np.where(first, falls, 0))
    flat, heights, upward, gamma0 = flat[top], heights[top], upward[order][top], gamma0[order][top]
    weight = np.where(upward >= _STEEP, upward, 0)
    lone = np.bincount(flat, weight, rows * columns)[flat] == 0
    weight = np.where(lone, 1.0, weight)
    total = np.bincount(flat, weight, rows * columns)
    with np.errstate(invalid="ignore"):
        means = [np.bincount(flat, weight * of, rows * columns) / total for of in (heights, gamma0)]
    return Uppermost(*(mean.reshape(shape) for mean in means))
