"""Masks of target and shadow, by comparing what target and ground return in each pixel."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Real, UInt8
from scipy.spatial import cKDTree

from sarsplat.gaussians import Gaussians, Ground
from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.renderer import render

_SHARE = 0.5  # minimum share of target, and maximum of ground, in a pixel's power without target
_LOWEST = 1.0  # minimum height above the ground of Gaussians of the target, resolution cells
_REACH = 1.5  # maximum distance of such Gaussians from the points, resolution cells


@torch.no_grad()
def scene_masks(
    target: Gaussians, ground: Ground | None, views: Sequence[View], grid: ImageGrid, rays: RayGrid
) -> UInt8[np.ndarray, "v {grid.rows} {grid.columns}"]:
    """Masks of a target on its ground: 0 clutter, 1 target, 2 shadow.

    Power is compared with that of the ground in the same pixel, if the target were absent. A pixel is

    - target, if the target returns at least half of it: a visible surface, with layover, unless it is much darker than
      the ground. Under a tilt, the comparison is with the ground without tilt, which does not enlarge the target;
    - shadow, if it is not target, and the radar sees less than half of the ground there;
    - clutter otherwise.

    Without ground there is no shadow, and areas across the line of sight are compared instead of power: target are
    pixels with at least half the area of flat ground or, aloft, of a plane at a grazing angle of 27°. Masks are as
    sharp as the pixels, whatever the resolution, and as exact as the rays are close.

    The labels of SARBake for measured chips are similar, but of a CAD model and by geometry: its lit surface projected
    on the slant plane, layover included, however dark; then its shadow on flat ground.
    """
    sharp = replace(grid, resolution_m=grid.spacing_m)
    masks = np.full((len(views), grid.rows, grid.columns), CLUTTER, np.uint8)
    channel = target.scattering.power_channel
    uniform = target.means.new_ones(1, len(target), channel + 1) if ground is None else None
    for mask, view in zip(masks, views, strict=True):  # single views, to bound memory
        rendering = render(target, [view], sharp, rays=rays, amplitudes=uniform, ground=ground)
        images = rendering.channel(channel)
        if ground is None or rendering.ground is None:
            free = torch.full_like(images, view.open_beta0)
        else:
            free = render(target[:0], [view], sharp, rays=rays, ground=ground).channel(channel)
            images = images - rendering.ground
            mask[(rendering.ground < _SHARE * free)[0].cpu().numpy()] = SHADOW
        shown = (images >= _SHARE * view.yardstick * free) & (images > 0)
        mask[shown[0].cpu().numpy()] = TARGET
    return masks


def without_imitated_ground(
    target: Gaussians, points: Real[np.ndarray, "p 3"], cell_m: float, ground: Ground | None
) -> Gaussians:
    """Drop the target's Gaussians that may only imitate ground.

    They are farther than 1.5 resolution cells of `cell_m` from all points that are higher than one cell or, on
    `ground`, lower than one cell themselves.
    """
    means = target.means.double().cpu().numpy()
    lowest = -np.inf if ground is None else _LOWEST * cell_m
    terrain = ground.height_m if ground is not None and isinstance(ground.height_m, Terrain) else None
    points = points[heights_of(points, terrain) >= lowest]
    if not len(points):
        return target[:0]
    keep = np.isfinite(cKDTree(points).query(means, distance_upper_bound=_REACH * cell_m)[0])
    keep &= heights_of(means, terrain) >= lowest
    return target[torch.from_numpy(keep).to(target.means.device)]
