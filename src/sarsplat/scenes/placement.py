"""Placement of a mesh: within its images, which are centred on the origin, and on the ground."""

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError, SarsplatWarning, counted
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, Terrain, View
from sarsplat.scenes.meshes import is_larger

_SUNK_CELLS = 0.5  # depth below the ground without a warning, resolution cells: wheels and tracks may sink in
_LITTLE = 0.01  # share of the surface below level ground without a warning
_FOUNDATIONS = 0.25  # share of the surface below terrain without a warning: houses have foundations
_CUT_OFF = 0.25  # share of the surface outside of an image without a warning
_LEANS = 0.02  # tolerance of y up, relative to the size: the mesh stands on y = 0 and is centred on z = 0
_ROUNDED = 0.1  # rounding of float32 without a warning, resolution cells


def recentred(mesh: Trimesh, *, aloft: bool = False) -> tuple[Trimesh, tuple[float, float, float]]:
    """Move a mesh: its middle above the origin, its lowest point to z = 0; aloft, its middle to the origin.

    Return also the vector that was subtracted, m.
    """
    low, high = mesh.bounds
    x, y, z = (float(value) for value in (low + high) / 2)
    moved = (x, y, z if aloft else float(low[2]))
    return mesh.copy().apply_translation([-value for value in moved]), moved


def shown_in(mesh: Trimesh, views: Sequence[View], grid: ImageGrid) -> list[bool]:
    """Return, for each image, True if the bounding box of a mesh reaches into it."""
    left, right, far, near = grid.extent_m
    corners = np.stack(np.meshgrid(*mesh.bounds.T), axis=-1).reshape(-1, 3)
    shown = []
    for view in views:
        azimuth, slant_range = view.look.gradients @ corners.T
        across = azimuth.max() >= left and azimuth.min() <= right
        shown.append(bool(across and slant_range.max() >= near and slant_range.min() <= far))
    return shown


def outside_images(mesh: Trimesh, views: Sequence[View], grid: ImageGrid) -> list[str]:
    """Return a warning if a mesh is outside of some images, or partly outside of one; raise if outside of all."""
    shown = shown_in(mesh, views, grid)
    if all(shown):
        return _cut_off(mesh, views, grid)
    where = "the target is around (" + ", ".join(f"{value:.10g}" for value in mesh.bounds.mean(axis=0)) + ") m"
    if not any(shown):
        raise SarsplatError(
            f"{where}, outside of all images, which are centred on the origin; give `recentre`, or subtract that from "
            "its coordinates"
        )
    return [
        f"{where}: {counted(shown.count(False), 'image')} of {len(shown)} cannot show it, as they are centred on the "
        "origin; give `recentre`, or more `pixels`"
    ]


def _cut_off(mesh: Trimesh, views: Sequence[View], grid: ImageGrid) -> list[str]:
    """Return a warning if a good part of a mesh that would fit is outside of an image."""
    left, right, far, near = grid.extent_m
    points = np.concatenate([np.asarray(mesh.triangles), np.asarray(mesh.triangles_center)[:, None]], axis=1)
    outside = []
    for view in views:
        azimuth, slant_range = np.moveaxis(points @ view.look.gradients.T, -1, 0)
        out = (azimuth < left) | (azimuth > right) | (slant_range < near) | (slant_range > far)
        outside.append(float(out.mean(axis=1) @ mesh.area_faces / mesh.area))
    if max(outside) < _CUT_OFF or is_larger(mesh, grid):
        return []
    return [
        f"{max(outside):.0%} of the target's surface is outside of an image, though it would fit; give `recentre`, or "
        "more `pixels`"
    ]


def lost_digits(mesh: Trimesh, grid: ImageGrid) -> list[str]:
    """Return a warning if the coordinates of a mesh are float32 and coarse, because it is far from the origin."""
    vertices = np.asarray(mesh.vertices)
    step = float(np.spacing(np.float32(np.abs(vertices).max())))
    if step <= _ROUNDED * min(grid.resolution_m) or (vertices != vertices.astype(np.float32)).any():
        return []
    return [
        f"the coordinates of the target are multiples of {step:.3g} m, like float32 far from the origin; subtract "
        f"{np.abs(mesh.bounds.mean(axis=0)).max():.3g} m or so before it is exported"
    ]


def warn_below_ground(mesh: Trimesh, grid: ImageGrid, ground_gamma0: float | None, terrain: Terrain | None) -> None:
    """Warn if a good part of a mesh is hidden below the ground."""
    if ground_gamma0 is None or not len(mesh.faces):
        return
    corners = np.asarray(mesh.triangles, np.float64)
    height = corners[..., 2]
    if terrain is not None:
        height = height - terrain.height_m(corners[..., 0], corners[..., 1])
    hidden = float((mesh.area_faces * _share_below(height)).sum())
    deepest, usual = -float(height.min()), _LITTLE if terrain is None else _FOUNDATIONS
    if not (deepest > _SUNK_CELLS * max(grid.resolution_m) and hidden >= usual * mesh.area > 0):  # also NaN
        return
    low, high = mesh.bounds
    level = _LEANS * float(mesh.extents.max())
    lying = terrain is None and abs(low[1]) < level and abs(low[2] + high[2]) < level
    remedy = "if y is up in the file, export it with z up; otherwise " if lying else ""
    warnings.warn(
        f"{hidden / mesh.area:.0%} of the target's surface is below the ground, up to {deepest:.3g} m, and hidden; "
        f"{remedy}raise it by {deepest:.3g} m, or recentre it",
        SarsplatWarning,
        stacklevel=1,  # one location, so that Python suppresses repetitions
    )


def _share_below(height: Float64[np.ndarray, "f 3"]) -> Float64[np.ndarray, " f"]:
    """Return the share of each triangle's area below 0, given the heights of its corners."""
    low, middle, high = np.sort(height, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        one_above = 1 - high**2 / ((high - low) * (high - middle))
        one_below = low**2 / ((middle - low) * (high - low))
    share: Float64[np.ndarray, " f"] = np.select(
        [low >= 0, high <= 0, middle <= 0], [np.zeros_like(low), np.ones_like(low), one_above], one_below
    )
    return share
