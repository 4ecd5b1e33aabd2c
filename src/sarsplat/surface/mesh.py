"""A triangle mesh through points with normals: signed distances on a voxel grid, and marching cubes.

The distance of a place is the weighted mean of those from the planes of the points around it (`planes.py`). Only what
was seen has points, so the mesh is open where no view looked, as below a vehicle. The grid is cut into bricks, of which
only those near points are looked at, one after the other: time grows with the surface, and memory hardly. Noise of
single points is left in such small triangles: they are turned to the normals around them (`fitting.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64, Real
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command
from sarsplat.progress import stage
from sarsplat.radiometry import shade
from sarsplat.surface.fitting import ROUNDS, fitted
from sarsplat.surface.planes import Planes, some_at_a_time
from sarsplat.surface.visibility import Seen

if TYPE_CHECKING:
    import trimesh

# Lengths in units of the planes.
_VOXEL = 0.25
_REACH = 0.15  # of the mesh from the nearest point

# A part that is smaller, of the whole area and in square units, floats.
_SMALLEST_PART, _SMALLEST_UNITS = 0.01, 1.5
_SEARCH, _NEAR, _FIT, _NORMALS = 60, 70, 90, 95  # per cent of the time, until they are done
_BRICK = 128  # voxels along a side
_DARKEST_DB = -30.0  # of the brightest vertex: black


def surface_mesh(
    points: Real[np.ndarray, "p 3"], normals: Real[np.ndarray, "p 3"], seen: Seen, cell: float
) -> trimesh.Trimesh:
    """The surface through points [P, 3], m, with unit normals that point outwards; vertices have what the radar saw.

    Voxels are 0.25 resolution cells, and no vertex is farther than 0.15 from a point; where points are sparse, of 7.5
    times their spacing. World frame, m; faces are counter-clockwise seen from outside. Vertices have the
    attribute `gamma0` (γ⁰, linear) and greys: decibels from 30 dB below the brightest vertex, black, to white. Parts of
    less than 1 % of the area and 1.5 squares of such sides are left out, and faces that the radar would have seen from
    behind. Without faces where the points make no surface.
    Refused if scikit-image or trimesh is missing.
    """
    try:
        import trimesh
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise SarsplatError(f"a mesh needs {error.name}, which is not installed; {install_command('mesh')}") from error
    vertices, faces, vertex_normals = np.empty((0, 3)), np.empty((0, 3), np.int64), None
    with stage("surface: mesh", 100) as shown:
        if len(points):
            planes = Planes.through(np.asarray(points, np.float64), normals, cell, seen.means.device)
            vertices, faces = _zero_surface(planes, marching_cubes, lambda share: shown.update(_SEARCH * share))
            near = np.empty(len(vertices), bool)
            for part in some_at_a_time(len(vertices)):
                near[part] = planes.apart(vertices[part]) <= _REACH * planes.unit_m
                shown.update(_SEARCH + (_NEAR - _SEARCH) * part.stop / len(vertices))
            faces = _from_the_front(vertices, faces[near[faces].all(axis=1)], seen)
            vertices, faces = _without_crumbs(vertices, faces, planes.unit_m)
            if len(faces):
                for done, moved in enumerate(fitted(vertices, faces, planes), 1):
                    vertices = moved
                    shown.update(_NEAR + (_FIT - _NEAR) * done / ROUNDS)
                vertex_normals = np.empty((len(vertices), 3))
                for part in some_at_a_time(len(vertices)):  # of many points: those of a voxel's few triangles jump
                    _, vertex_normals[part] = planes.at(vertices[part])
                    shown.update(_FIT + (_NORMALS - _FIT) * part.stop / len(vertices))
        gamma0, _ = seen.around(vertices)
        shown.update(100)
    grey = np.uint8(np.round(255 * shade(gamma0, gamma0.max(initial=np.finfo(float).tiny), -_DARKEST_DB)))
    return trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=vertex_normals,
        vertex_colors=np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1),
        vertex_attributes={"gamma0": gamma0.astype(np.float32)},
        process=False,
    )


def _zero_surface(
    planes: Planes, marching_cubes: Callable[..., tuple[np.ndarray, ...]], tell: Callable[[float], object]
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Vertices, m, and faces where the signed distance, positive outside, changes its sign near points.

    Of the time that takes, it tells the part that is over.
    """
    unit = planes.unit_m
    voxel = _VOXEL * unit
    band = _REACH * unit + 2 * voxel  # beyond what is kept: cubes at its rim are whole
    points = planes.points
    corner = points.min(axis=0) - band
    voxels = np.rint((points - corner) / voxel).astype(np.int64)
    order, starts = _sorted(voxels)
    occupied = voxels[order[starts]]
    margin = int(band / voxel) + 1  # cubes begin one before what is near, or end one behind
    bricks = _bricks(occupied, margin)
    vertices, faces, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    done, total = 0, sum(len(near_by) for _, near_by in bricks)
    for brick, near_by in bricks:
        first, last = near_by.min(axis=0), near_by.max(axis=0)
        low, high = np.maximum(brick, first - margin), np.minimum(brick + _BRICK, last + margin)
        start, end = np.minimum(low, first), np.maximum(high, last)
        empty = np.ones(end - start + 1, dtype=bool)
        empty[tuple((near_by - start).T)] = False
        inside = tuple(slice(begin, begin + size) for begin, size in zip(low - start, high - low + 1, strict=True))
        near = (distance_transform_edt(empty, sampling=voxel) <= band)[inside]
        distance = np.full(near.shape, unit)
        distance[near], _ = planes.at((np.argwhere(near) + low) * voxel + corner)
        done += len(near_by)
        tell(done / total)
        if not distance.min() < 0 < distance.max():
            continue
        try:
            some, triangles, _, _ = marching_cubes(distance, 0.0, mask=near, allow_degenerate=False)
        except RuntimeError:  # no cube whose corners are all near has the surface in it
            continue
        vertices.append(some + low.astype(np.float64))
        faces.append(triangles.astype(np.int64) + count)
        count += len(some)
    joined, owner = _welded(np.concatenate(vertices))
    return joined * voxel + corner, owner[np.concatenate(faces)]


def _sorted(voxels: Int64[np.ndarray, "v 3"]) -> tuple[Int64[np.ndarray, " v"], Int64[np.ndarray, " d"]]:
    """Sorting permutation of rows, and where runs of equal rows begin; ten times as fast as `numpy.unique` of rows."""
    order = np.lexsort(voxels.T[::-1])
    ranked = voxels[order]
    return order, np.flatnonzero(np.append(True, (ranked[1:] != ranked[:-1]).any(axis=1)))


def _bricks(
    occupied: Int64[np.ndarray, "o 3"], margin: int
) -> list[tuple[Int64[np.ndarray, " 3"], Int64[np.ndarray, "n 3"]]]:
    """First voxels of the bricks near occupied voxels, and those that reach into each: at most `margin` from it."""
    members: dict[tuple[int, ...], list[Int64[np.ndarray, "n 3"]]] = {}
    first, last = (occupied - margin) // _BRICK, (occupied + margin) // _BRICK
    for step in product((0, 1), repeat=3):  # margins are shorter than bricks
        brick = first + np.array(step)
        reached = (brick <= last).all(axis=1)
        if not reached.any():
            continue
        order, starts = _sorted(brick[reached])
        keys = brick[reached][order[starts]].tolist()
        for key, part in zip(keys, np.split(occupied[reached][order], starts[1:]), strict=True):
            members.setdefault(tuple(key), []).append(part)
    return [(_BRICK * np.array(key), np.concatenate(parts)) for key, parts in sorted(members.items())]


def _welded(
    vertices: Float64[np.ndarray, "v 3"],
) -> tuple[Float64[np.ndarray, "w 3"], Int64[np.ndarray, " v"]]:
    """Vertices, in voxels, without the doubles where bricks touch, and which of them each one is.

    An edge between two voxels has one vertex at most, whose place on it is a rounding apart in both bricks.
    """
    on_face = (vertices % _BRICK == 0).any(axis=1)
    edges = np.floor(vertices[on_face]) + np.ceil(vertices[on_face])
    _, first, same = np.unique(edges, axis=0, return_index=True, return_inverse=True)
    owner = np.empty(len(vertices), np.int64)
    owner[on_face], owner[~on_face] = same.ravel(), len(first) + np.arange((~on_face).sum())
    return np.concatenate([vertices[on_face][first], vertices[~on_face]]), owner


def _from_the_front(
    vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], seen: Seen
) -> Int64[np.ndarray, "g 3"]:
    """Faces whose outer side looks to where the radar was, on average of the views that see what is there."""
    front = np.empty(len(faces), bool)
    for part in some_at_a_time(len(faces)):
        a, b, c = np.moveaxis(vertices[faces[part]], 1, 0)
        _, towards = seen.around((a + b + c) / 3)
        front[part] = np.einsum("fc,fc->f", np.cross(b - a, c - a), towards) >= 0
    return faces[front]


def _without_crumbs(
    vertices: Real[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], unit_m: float
) -> tuple[Real[np.ndarray, "w 3"], Int64[np.ndarray, "g 3"]]:
    """Connected parts that are not small against the whole, and only the vertices they need."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(ends), bool), tuple(ends.T)), shape=(len(vertices), len(vertices)))
    part = connected_components(links, directed=False)[1][faces[:, 0]]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    area = np.bincount(part, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    faces = faces[area[part] >= min(_SMALLEST_PART * area.sum(), _SMALLEST_UNITS * unit_m**2)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)
