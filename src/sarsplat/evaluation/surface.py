"""The visible part of the true surface, against which reconstructed points are scored (protocol R)."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Float64

from sarsplat.arguments import check_number, checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.points import order_in_space
from sarsplat.extras import Trimesh
from sarsplat.geometry import View
from sarsplat.geometry.view import ground_radius_m
from sarsplat.scenes.meshes import read_mesh
from sarsplat.scenes.surface_samples import surface_samples
from sarsplat.surface.points import imaged

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

    from sarsplat.data import Dataset

_BATCH = 1_000_000  # rays traced at once
_MAX_RAYS = 10_000_000  # maximum number of rays of a view; in large scenes they are farther apart
_LIFT = 1e-5  # distance from the surface at which shadow rays start, relative to the mesh: 100 times float32's rounding
_THICKNESS_M = 1e-3  # thickness of the ground, m
_MAX_SAMPLES = 4_000_000  # drawn at once, when most of them are hidden
_THREADS = min(8, os.cpu_count() or 1)  # each holds a batch of rays, so more would take gigabytes
_POINTS = 50_000  # tested at once in a thread


@dataclass(frozen=True)
class VisibleSurface:
    """True surface, whole and the part visible from at least one view, world frame, m."""

    triangles: Float64[np.ndarray, "visible 3 3"]
    """Triangles that at least one ray hits first (vertex, coordinate last)."""
    all_triangles: Float64[np.ndarray, "all 3 3"]
    """Every triangle of the mesh."""
    samples: Float32[np.ndarray, "s 3"]
    """Area-weighted random points of the visible surface, each of them visible."""
    samples_whole: Float32[np.ndarray, "w 3"]
    """Area-weighted random points of every triangle."""


def read_truth_mesh(path: Path) -> Trimesh:
    """Read the true mesh of a dataset, unchanged.

    Raises `SarsplatError` if it cannot be read, has no faces, or has missing or non-finite vertices.
    """
    try:
        mesh = read_mesh(path)
    except SarsplatError as error:
        raise SarsplatError(f"the true mesh cannot be used: {error}") from error
    if not np.isfinite(mesh.vertices).all():
        raise SarsplatError(f"the true mesh {path} holds vertices that are not finite; repair it, or give another")
    return mesh


def of_stacks(mesh: Trimesh, dataset: Dataset) -> Trimesh:
    """Add level ground to the mesh if images show any: stacks are scored on ground, too."""
    import trimesh

    if not dataset.ground:
        return mesh
    side = 2 * ground_radius_m(dataset.views, dataset.grid)
    ground = trimesh.creation.box((side, side, _THICKNESS_M))
    ground.apply_translation((0.0, 0.0, -_THICKNESS_M / 2))
    return trimesh.util.concatenate(mesh, ground)  # type: ignore[return-value]


def imaged_alone(surface: VisibleSurface, dataset: Dataset) -> VisibleSurface:
    """Keep the samples that a training image shows."""
    views = dataset.select("train").views
    inside = np.any([imaged(surface.samples.astype(np.float64), view, dataset.grid) for view in views], axis=0)
    return replace(surface, samples=surface.samples[inside])


@checks_arguments
def visible_surface(
    mesh: Trimesh,
    views: Sequence[View],
    ray_spacing: float,
    *,
    samples: int = 1_000_000,
    seed: int = 0,
    advanced: Callable[[float], object] = lambda share: None,
) -> VisibleSurface:
    """Find triangles and samples of the surface that at least one of the views sees.

    Surfaces are two-sided, as many meshes have no reliable outside.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        True surface in the world frame, m.
    views : sequence of View
        The training views.
    ray_spacing : float
        Spacing of the parallel rays that find visible triangles, m; `Yardstick.ray_spacing_m` for scores. It is
        increased to limit a view to ten million rays.
    samples : int
        Number of samples of the visible and of the whole surface.
    seed : int
        Seed of the random samples.
    advanced : callable, optional
        Called from time to time with the share of the work done, 0 to 1.

    Raises
    ------
    SarsplatError
        If there is no view, no ray hits the mesh, or a number is not positive and finite.
    """
    if not views:
        raise SarsplatError("the visible surface needs at least one view; give the training views")
    check_number("ray_spacing", ray_spacing, 0, above=True)
    check_number("samples", samples, 1)
    if not (mesh.area > 0 and np.isfinite(mesh.bounds).all()):
        raise SarsplatError(f"the mesh ({len(mesh.faces)} triangles) has no surface; give a mesh with an area")
    scene = _scene(mesh)
    visible = np.zeros(len(mesh.faces), dtype=bool)
    with ThreadPoolExecutor(_THREADS) as threads:
        hits = threads.map(lambda view: _first_hits(scene, mesh, view, ray_spacing), views)
        for number, hit in enumerate(hits, 1):
            visible |= hit
            advanced(number / len(views) / 2)
    if not visible.any():
        raise SarsplatError(
            f"no ray hits the mesh: its parts are smaller than the ray spacing of {ray_spacing:.3g} m; use a finer one"
        )

    generator = np.random.default_rng(seed)
    whole = surface_samples(mesh, samples, generator)
    weight, lift = mesh.area_faces * visible, _LIFT * mesh.scale
    seen, missing, fraction = [np.empty((0, 3), np.float32)], samples, 1.0
    while missing > 0:
        count = min(int(missing / fraction * 1.02) + 100, _MAX_SAMPLES)
        candidates = surface_samples(mesh, count, generator, weight)
        lit = candidates[_are_seen(scene, candidates, views, lift)][:missing].astype(np.float32)
        seen.append(lit)
        missing -= len(lit)
        advanced(1 - missing / samples / 2)
        fraction = max(len(lit) / count, 1e-3)
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    return VisibleSurface(triangles[visible], triangles, np.concatenate(seen), whole.astype(np.float32))


def _scene(mesh: Trimesh) -> EmbreeScene:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(robust=True)  # robust: no ray slips through between two triangles
    TriangleMesh(scene, np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32))
    return scene


def _first_hits(scene: EmbreeScene, mesh: Trimesh, view: View, spacing: float) -> Bool[np.ndarray, " t"]:
    """Mask of the triangles that rays of a view hit first."""
    hit, away = np.zeros(len(mesh.faces), dtype=bool), (-view.look.facing).astype(np.float32)[None]
    for origins in _lattice(np.asarray(mesh.vertices), view, spacing):
        numbers = scene.run(origins, away)
        hit[numbers[numbers >= 0]] = True
    return hit


def _lattice(
    vertices: Float64[np.ndarray, "n 3"], view: View, spacing: float
) -> Iterator[Float32[np.ndarray, "rays 3"]]:
    """Yield batches of ray origins, float32 [≤ batch, 3]: a lattice on the computation plane, before the mesh."""
    frame = view.look.frame
    low, high = (vertices @ frame.T).min(axis=0), (vertices @ frame.T).max(axis=0)
    spacing = max(spacing, math.sqrt((high[0] - low[0]) * (high[1] - low[1]) / _MAX_RAYS))
    x, y = ((np.arange(np.floor(low[k] / spacing), np.ceil(high[k] / spacing)) + 0.5) * spacing for k in (0, 1))
    lines = max(1, _BATCH // max(1, len(x)))
    for first in range(0, len(y), lines):
        along = y[first : first + lines, None] * frame[1] + (low[2] - spacing) * frame[2]
        yield (along[:, None] + x[:, None] * frame[0]).reshape(-1, 3).astype(np.float32)


def _are_seen(
    scene: EmbreeScene, points: Float64[np.ndarray, "p 3"], views: Sequence[View], lift: float
) -> Bool[np.ndarray, " p"]:
    """Mask of the surface points from which a ray, starting `lift` (m) above, reaches the radar of a view."""
    order, seen = order_in_space(points), np.empty(len(points), dtype=bool)
    views = [views[index] for index in _spread(len(views))]
    parts = [order[first : first + _POINTS] for first in range(0, len(order), _POINTS)]
    with ThreadPoolExecutor(_THREADS) as threads:
        for part, found in zip(parts, threads.map(lambda part: _seen(scene, points[part], views, lift), parts)):
            seen[part] = found
    return seen


def _seen(
    scene: EmbreeScene, points: Float64[np.ndarray, "p 3"], views: Sequence[View], lift: float
) -> Bool[np.ndarray, " p"]:
    hidden = np.arange(len(points))
    for view in views:
        origins = (points[hidden] + lift * view.look.facing).astype(np.float32)
        hidden = hidden[scene.run(origins, view.look.facing.astype(np.float32)[None], query="OCCLUDED") >= 0]
        if len(hidden) == 0:
            break
    return np.bincount(hidden, minlength=len(points)) == 0


def _spread(count: int) -> list[int]:
    """Indices 0 … count − 1 in an order that starts with distant ones: a few views see most of a surface."""
    bits = (count - 1).bit_length()
    return sorted(range(count), key=lambda index: f"{index:0{bits}b}"[::-1])
