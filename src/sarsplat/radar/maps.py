"""Radar maps: height, incidence angle, layover and shadow in each pixel of a view."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from sarsplat.arguments import checks_arguments
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.radar.surface import Surface
from sarsplat.renderer import attenuate, project, splat
from sarsplat.surface.from_above import HIDDEN, transmittance_at

_SHARE = 0.5  # minimum share of a target's pixel that it covers, or of the area that flat ground would have in it
_SAMPLES = 3  # sampled places of a pixel's ground, per axis
_GRAZED = 0.02  # cosine below which a surface counts as parallel to a direction
_SAME_PLACE = 0.05  # minimum distance of scatterers that determine a slope, pixel spacings


@dataclass(frozen=True)
class RadarMaps:
    """Geometry of the surface in each pixel of one image, independent of scattering.

    Every array is float32 or bool [rows, columns], row 0 near range. Parts of the surface that share a pixel are
    weighted by their visible area across the line of sight.

    Parameters
    ----------
    height_m : numpy.ndarray
        Mean height z of the first returns in the pixel, m; NaN without target.
    incidence_deg : numpy.ndarray
        Mean local incidence angle, degrees: 0 for a surface that faces the radar, 90 at grazing incidence; NaN without
        target.
    spread_m : numpy.ndarray
        Spread along elevation of the scatterers in the pixel, m: the distance of two equally large ones. The spread of
        a single slope does not count. NaN without target.
    layover : numpy.ndarray
        True if the spread exceeds a resolution cell: parts of the target share the pixel.
    shadow : numpy.ndarray
        True if the target hides the pixel's flat ground at z = 0, and is not seen in the pixel itself.
    """

    height_m: Float[np.ndarray, "rows columns"]
    incidence_deg: Float[np.ndarray, "rows columns"]
    spread_m: Float[np.ndarray, "rows columns"]
    layover: Bool[np.ndarray, "rows columns"]
    shadow: Bool[np.ndarray, "rows columns"]


@torch.no_grad()
@checks_arguments
def radar_maps(surface: Surface, view: View, grid: ImageGrid, *, rays: RayGrid | None = None) -> RadarMaps:
    """Make radar maps of a surface on flat ground at z = 0, or aloft, where it throws no shadow.

    Maps are as sharp as the pixels, whatever the images' resolution.

    Parameters
    ----------
    surface : Surface
        Target; see `surface_of_run` and `surface_of_mesh`.
    view : View
        View of the radar.
    grid : ImageGrid
        Pixels; the resolution cell is the threshold of layover.
    rays : RayGrid, optional
        Rays that find the visible surface; by default two per pixel spacing.

    Returns
    -------
    RadarMaps
        Arrays [rows, columns].
    """
    rays, gaussians = rays or RayGrid.for_image(grid), surface.gaussians.detach()
    sharp = replace(grid, resolution_m=grid.spacing_m)
    if len(gaussians) == 0:
        shape = grid.rows, grid.columns
        nan, false = np.full(shape, np.nan, np.float32), np.zeros(shape, bool)
        return RadarMaps(nan, nan, nan, false, false)
    projection = project(gaussians, [view], sharp, rays=rays)
    lit = attenuate(projection, rays).lit_area[0]
    weighted = lit[:, None] * torch.from_numpy(_columns(surface, view)).to(lit)
    sums = splat(projection.pixels, weighted[None], sharp)[0].double().numpy()
    area = sums[_AREA]
    open_area = view.yardstick * view.open_beta0  # as `area`, of flat ground: across the line of sight, per image area
    shown = (area >= _SHARE * open_area) | (sums[_COVER] >= _SHARE)
    means = np.divide(sums, area, out=np.full_like(sums, np.nan), where=shown)
    spread = 2 * np.sqrt(_unexplained(means, grid))  # two equally large scatterers are two standard deviations apart
    with np.errstate(invalid="ignore"):
        layover = spread > grid.cell_m
    standing = gaussians[:0] if view.aloft else gaussians[gaussians.means[:, 2] > 0]  # may throw shadow on z = 0
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
    """Terms of a pixel's sums per Gaussian and visible area: area, height, incidence, cover, and moments of places.

    Cover is area in the image: visible area across the line of sight, seen along the elevation axis instead.
    """
    means, frame = surface.gaussians.means.double().numpy(), view.look.frame
    azimuth, elevation, slant_range = frame @ means.T
    place = np.stack([azimuth, slant_range, elevation - elevation.mean()], axis=1)  # centred for float32 sums
    _, across, towards = np.abs(frame @ surface.normals.T).clip(_GRAZED, 1)
    named = [np.ones(len(means)), means[:, 2], np.degrees(np.arccos(towards)), across / towards]
    return np.column_stack([*named, place, place[:, _PAIRS[0]] * place[:, _PAIRS[1]]])


def _unexplained(means: Float64[np.ndarray, "13 rows columns"], grid: ImageGrid) -> Float64[np.ndarray, "rows columns"]:
    """Variance of the elevation around the plane fitted to each pixel, m²."""
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
    """Mask of the pixels whose ground is hidden by Gaussians above it."""
    if len(gaussians) == 0:
        return np.zeros((grid.rows, grid.columns), bool)
    offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5  # of samples from the pixel's centre, pixels
    azimuth, slant_range = np.meshgrid(
        (grid.azimuth_m[:, None] + offsets * grid.spacing_m[0]).ravel(),
        (grid.range_m[:, None] + offsets * grid.spacing_m[1]).ravel(),
    )
    elevation = view.look.elevation_on_ground(azimuth, slant_range)
    transmittance = transmittance_at(gaussians, view, grid, rays, azimuth, elevation)
    means = transmittance.reshape(grid.rows, _SAMPLES, grid.columns, _SAMPLES).mean(axis=(1, 3))
    return means < 1 - HIDDEN
