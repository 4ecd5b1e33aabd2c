"""Radar maps: height, incidence angle, layover and shadow in each pixel of a view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.ndimage import map_coordinates

from sarsplat.arguments import checks_arguments
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.radar.surface import Surface, above_ground
from sarsplat.renderer import RayMap, attenuate, project, splat

_SHARE = 0.5
"""A pixel shows the target if that covers this share of it, or this share of the area that flat ground would have."""

_HIDDEN = 0.5
"""Ground is in shadow if the target takes this share of its light, on the way to it and back."""

_SAMPLES = 3
"""Rays per pixel and axis that look for its ground."""

_GRAZED = 0.02
"""Cosine below which a surface counts as parallel to a direction."""

_SAME_PLACE = 0.05
"""Scatterers nearer to one another than this do not determine a slope; in pixel spacings."""


@dataclass(frozen=True)
class RadarMaps:
    """What each pixel of one image sees, however strongly it scatters: geometry, not power.

    Every array is float32 or bool [rows, columns], row 0 near range. Where several parts of the surface share a pixel,
    each counts by the area across the line of sight over which the radar sees it.

    Parameters
    ----------
    height_m : numpy.ndarray
        Mean height z of the first returns in the pixel, m; NaN where there is no target.
    incidence_deg : numpy.ndarray
        Mean local incidence angle, degrees: 0 for a surface that faces the radar, 90 for one that is only grazed; NaN
        where there is no target.
    spread_m : numpy.ndarray
        How far apart along elevation the scatterers that share the pixel lie, m: for two equally large ones their
        distance. What a single slope spreads over a pixel does not count. NaN where there is no target.
    layover : numpy.ndarray
        Whether that is more than a resolution cell: parts of the target lie over one another.
    shadow : numpy.ndarray
        Whether the target hides the flat ground at z = 0 that the pixel would show, and is not seen there itself.
    """

    height_m: Float[np.ndarray, "rows columns"]
    incidence_deg: Float[np.ndarray, "rows columns"]
    spread_m: Float[np.ndarray, "rows columns"]
    layover: Bool[np.ndarray, "rows columns"]
    shadow: Bool[np.ndarray, "rows columns"]


@torch.no_grad()
@checks_arguments
def radar_maps(surface: Surface, view: View, grid: ImageGrid, *, rays: RayGrid | None = None) -> RadarMaps:
    """Maps of what a radar sees of a surface that stands on flat ground at z = 0, or is aloft and throws no shadow.

    The maps are as sharp as the pixels, whatever the resolution of the images is.

    Parameters
    ----------
    surface : Surface
        The target; see `surface_of_run` and `surface_of_mesh`.
    view : View
        From where.
    grid : ImageGrid
        Where the pixels lie; its resolution cell is what counts as layover.
    rays : RayGrid, optional
        Rays that find what is seen; two to a pixel spacing unless given.

    Returns
    -------
    RadarMaps
        Arrays [rows, columns].
    """
    rays, gaussians = rays or RayGrid.for_image(grid), surface.gaussians.detach()
    sharp = replace(grid, resolution_m=grid.spacing_m)
    if len(gaussians) == 0:
        nothing, none = (
            np.full((grid.rows, grid.columns), np.nan, np.float32),
            np.zeros((grid.rows, grid.columns), bool),
        )
        return RadarMaps(nothing, nothing, nothing, none, none)
    projection = project(gaussians, [view], sharp, rays=rays)
    lit = attenuate(projection, rays).lit_area[0]
    weighted = lit[:, None] * torch.from_numpy(_columns(surface, view)).to(lit)
    sums = splat(projection.pixels, weighted[None], sharp)[0].double().numpy()
    area = sums[_AREA]
    shown = (area >= _SHARE * view.yardstick * view.open_beta0) | (sums[_COVER] >= _SHARE)
    means = np.divide(sums, area, out=np.full_like(sums, np.nan), where=shown)
    spread = 2 * np.sqrt(_unexplained(means, grid))
    with np.errstate(invalid="ignore"):
        layover = spread > grid.cell_m
    standing = gaussians[:0] if view.aloft else above_ground(gaussians)
    shadow = _hidden_ground(standing, view, grid, rays) & ~shown
    return RadarMaps(
        means[_HEIGHT].astype(np.float32),
        means[_INCIDENCE].astype(np.float32),
        spread.astype(np.float32),
        layover,
        shadow,
    )


_AREA, _HEIGHT, _INCIDENCE, _COVER = range(4)
_FIRST, _SECOND = slice(4, 7), slice(7, 13)  # moments of (azimuth, range, elevation)
_PAIRS = np.triu_indices(3)


def _columns(surface: Surface, view: View) -> Float64[np.ndarray, "n 13"]:
    """Per-Gaussian terms of the weighted sums of a pixel, per unit of area across the line of sight."""
    means, frame = surface.gaussians.means.double().numpy(), view.look.frame
    azimuth, elevation, slant_range = frame @ means.T
    place = np.stack([azimuth, slant_range, elevation - elevation.mean()], axis=1)  # float32 sums lose few digits
    _, across, towards = np.abs(frame @ surface.normals.T).clip(_GRAZED, 1)
    named = [np.ones(len(means)), means[:, 2], np.degrees(np.arccos(towards)), across / towards]
    return np.column_stack([*named, place, place[:, _PAIRS[0]] * place[:, _PAIRS[1]]])


def _unexplained(means: Float64[np.ndarray, "13 rows columns"], grid: ImageGrid) -> Float64[np.ndarray, "rows columns"]:
    """Variance of the elevation that no slope explains, m²: what is left after a plane was fitted in each pixel."""
    first = means[_FIRST]
    (aa, ar, ae, rr, re, ee) = means[_SECOND] - first[_PAIRS[0]] * first[_PAIRS[1]]
    aa, rr = (
        variance.clip(0) + (_SAME_PLACE * spacing) ** 2
        for variance, spacing in zip((aa, rr), grid.spacing_m, strict=True)
    )
    determinant = np.maximum(aa * rr - ar**2, 1e-6 * aa * rr)
    return np.maximum(ee - (rr * ae**2 - 2 * ar * ae * re + aa * re**2) / determinant, 0)


def _hidden_ground(
    gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid
) -> Bool[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Whether Gaussians above the ground take the light of the ground that each pixel would show.

    The ray that ends there meets whatever is above the ground before it.
    """
    if len(gaussians) == 0:
        return np.zeros((grid.rows, grid.columns), bool)
    projection = project(gaussians, [view], grid, rays=rays)
    (ray_map,) = attenuate(projection, rays, first_return_depth=1.0).ray_maps or ()
    inside = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    azimuth, slant_range = np.meshgrid(
        (grid.azimuth_m[:, None] + inside * grid.spacing_m[0]).ravel(),
        (grid.range_m[:, None] + inside * grid.spacing_m[1]).ravel(),
    )
    through = _transmittance(ray_map, rays, azimuth, view.look.elevation_on_ground(azimuth, slant_range))
    means = through.reshape(grid.rows, _SAMPLES, grid.columns, _SAMPLES).mean(axis=(1, 3))
    return means < 1 - _HIDDEN


def _transmittance(
    ray_map: RayMap, rays: RayGrid, azimuth: Float64[np.ndarray, "r c"], elevation: Float64[np.ndarray, "r c"]
) -> Float64[np.ndarray, "r c"]:
    """Two-way, at places on the computation plane; 1 where no ray was needed."""
    row = (elevation - ray_map.origin[1]) / rays.spacing_m[1]
    column = (azimuth - ray_map.origin[0]) / rays.spacing_m[0]
    return map_coordinates(ray_map.transmittance.double().numpy(), [row, column], order=1, mode="constant", cval=1.0)
