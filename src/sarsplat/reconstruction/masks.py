"""Which pixels show a target and which its shadow, by what each part of a scene returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Real, UInt8
from scipy.spatial import cKDTree

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, RayGrid, View
from sarsplat.radiometry import beta0_of_gamma0
from sarsplat.renderer import attenuate, project, splat

_SHARE = 0.5
_LOWEST = 1.0  # height above the ground from which Gaussians count as the target, resolution cells
_REACH = 1.5  # and how near the points, resolution cells


@torch.no_grad()
def scene_masks(
    scene: Gaussians, target: int, views: Sequence[View], grid: ImageGrid, rays: RayGrid
) -> UInt8[np.ndarray, "v {grid.rows} {grid.columns}"]:
    """Masks of a scene: its first Gaussians, `target` of them, are the target, the others its ground.

    The yardstick is what the ground would return in a pixel without the target. A pixel is

    - target, if the target returns at least half of that there: wherever a surface that the radar sees appears, with
      layover, unless it is much darker than the ground;
    - shadow, if it is not target, and the ground returns less than half of what it would;
    - clutter otherwise.

    Without ground there is no shadow, and target are the pixels in which the radar sees at least half as much of it as
    it would of flat ground, by area across the line of sight.

    The labels of SARBake, which predictions for measured chips are compared with, are the same of a CAD model, with
    geometry in place of power: its lit surface projected on the slant plane, layover included, however dark it is; then
    its shadow on flat ground.

    Parameters
    ----------
    scene : Gaussians
        Target and ground.
    target : int
        How many of them are the target.
    views, grid
        From where, and where the pixels lie; what they show is as sharp as they are, whatever the resolution.
    rays : RayGrid
        Their spacing decides how exact the returns are.

    Returns
    -------
    numpy.ndarray, uint8 [V, rows, columns]
        0 clutter, 1 target, 2 shadow.
    """
    sharp = replace(grid, resolution_m=grid.spacing_m)
    masks = np.full((len(views), grid.rows, grid.columns), CLUTTER, np.uint8)
    if len(scene) == 0:
        return masks
    uniform = target == len(scene)
    for mask, view in zip(masks, views, strict=True):  # one at a time: memory stays small
        of_target, of_ground = _returns(scene, target, view, sharp, rays, uniform)
        if uniform:
            free = np.full_like(of_ground, beta0_of_gamma0(1.0, view.grazing_deg))
        else:
            _, free = _returns(scene[target:], 0, view, sharp, rays, uniform)
            mask[of_ground < _SHARE * free] = SHADOW
        mask[(of_target >= _SHARE * free) & (of_target > 0)] = TARGET
    return masks


def without_imitated_ground(
    scene: Gaussians, target: int, points: Real[np.ndarray, "p 3"], cell_m: float
) -> tuple[Gaussians, int]:
    """The scene without those of its first `target` Gaussians that may stand for ground as well as the others do.

    They are those farther than 1.5 resolution cells of `cell_m` from all points that are higher than one cell and, if
    the scene has ground, those lower than one cell themselves.

    Returns
    -------
    Gaussians
        What is left.
    int
        How many of the first are among it.
    """
    means = scene.means[:target].double().cpu().numpy()
    kept = np.ones(len(scene), bool)
    lowest = _LOWEST * cell_m if target < len(scene) else -np.inf
    points = points[points[:, 2] >= lowest]
    if len(points):
        kept[:target] = np.isfinite(cKDTree(points).query(means, distance_upper_bound=_REACH * cell_m)[0])
        kept[:target] &= means[:, 2] >= lowest
    else:
        kept[:target] = False
    return scene[torch.from_numpy(kept).to(scene.means.device)], int(kept[:target].sum())


def _returns(
    scene: Gaussians, target: int, view: View, grid: ImageGrid, rays: RayGrid, uniform: bool
) -> Float[np.ndarray, "2 {grid.rows} {grid.columns}"]:
    """β⁰ of the target and of the ground; `uniform`: as if all had the γ⁰ 1."""
    projection = project(scene, [view], grid, rays=rays)
    sections = attenuate(projection, rays).lit_area
    if not uniform:
        sections = sections * projection.amplitudes[..., scene.scattering.power_channel]
    kind = torch.zeros(len(scene), 2, device=sections.device)
    kind[:target, 0] = kind[target:, 1] = 1
    return splat(projection.pixels, sections[..., None] * kind, grid)[0].cpu().numpy()
