"""Triangle mesh through points with normals: signed distances on a voxel grid, marching cubes, and smoothing.

The signed distance is a weighted mean over the planes of the surfels around a place (A. C. Öztireli, G. Guennebaud and
M. Gross, "Feature preserving point set surfaces based on non-linear kernel regression", Computer Graphics Forum 2009):
surfels whose normals differ from the mean lose weight in each round, so that edges stay. The mesh is open where no
view looked, as below a vehicle. Bricks of the grid near points are processed one after the other: time grows with the
surface, memory hardly. Finally triangles are rotated to the normals around them, which removes the noise of points.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Float64, Int64, Real
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.extras import Trimesh, needed
from sarsplat.progress import stage
from sarsplat.radiometry import shade
from sarsplat.surface import cells
from sarsplat.surface.cells import CUBE, Surfels, dot
from sarsplat.surface.neighbours import Neighbours, Tree, neighbours_of
from sarsplat.surface.visibility import Seen

_VOXEL = 0.25  # units of the planes
_REACH = 0.15  # maximum distance of the mesh from the nearest point, units of the planes
_SMALLEST_PART, _SMALLEST_UNITS = 0.01, 1.5  # minimum area of a part, relative to the whole, and in square units
_SEARCH, _NEAR, _FIT, _NORMALS = 60, 70, 90, 95  # progress at the end of each stage, per cent
_BRICK = 128  # voxels along a side
_DARKEST_DB = -30.0  # black, relative to the brightest vertex
_FIT_ROUNDS = 2
_FIT_STEPS = 40
_FIT_KEPT = 0.5  # weight of a vertex's old place, relative to an edge
_FIT_LEAST = 0.2  # minimum of 1 + cosine of the rotation: no triangle is turned over
_SPACINGS = 7.5  # minimum of the unit, spacings of the points, so that the mesh has no holes between them
_SMOOTHING = 0.25  # standard deviation of the surfels' weights, units
_NEIGHBOURS = 32  # surfels that count for a place
_PLANE_ROUNDS = 2
_UNLIKE = 0.5  # distance of unit normals from the mean at which a surfel's weight is 1/e
_AT_ONCE = 50_000  # places in a batch
_SUMMED = 4096  # places in a batch on the CPU, for its caches
_MEASURED = 10_000  # maximum number of points whose nearest neighbour gives the spacing


def surface_mesh(points: Real[np.ndarray, "p 3"], normals: Real[np.ndarray, "p 3"], seen: Seen, cell: float) -> Trimesh:
    """Mesh through points [P, 3], m, with outward unit normals; it has no faces if they make no surface.

    Lengths are in resolution cells or, for sparse points, 7.5 times their spacing: voxels are 0.25, and no vertex is
    farther than 0.15 from a point. World frame, m; faces are counter-clockwise seen from outside. Vertices have the
    attribute `gamma0` (γ⁰, linear) and greys: black is 30 dB below the brightest vertex. Parts of less than 1 % of the
    area and 1.5 square units are left out, and faces that the radar would have seen from behind. Raises without
    scikit-image or trimesh.
    """
    with needed("mesh", "a mesh"):
        import trimesh
        from skimage.measure import marching_cubes
    vertices, faces, vertex_normals = np.empty((0, 3)), np.empty((0, 3), np.int64), None
    with stage("surface: mesh", 100) as shown:
        if len(points):
            planes = Planes.through(np.asarray(points, np.float64), normals, cell, seen.means.device)
            vertices, faces = _zero_surface(planes, marching_cubes, lambda share: shown.update(_SEARCH * share))
            near = np.empty(len(vertices), bool)
            for part in batches(len(vertices)):
                near[part] = planes.distance_m(vertices[part]) <= _REACH * planes.unit_m
                shown.update(_SEARCH + (_NEAR - _SEARCH) * part.stop / len(vertices))
            faces = _from_the_front(vertices, faces[near[faces].all(axis=1)], seen)
            vertices, faces = _without_crumbs(vertices, faces, planes.unit_m)
            if len(faces):
                for done, moved in enumerate(_fitted(vertices, faces, planes), 1):
                    vertices = moved
                    shown.update(_NEAR + (_FIT - _NEAR) * done / _FIT_ROUNDS)
                vertex_normals = np.empty((len(vertices), 3))
                for part in batches(len(vertices)):  # of the planes: normals of few triangles are noisy
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
    planes: "Planes", marching_cubes: Callable[..., tuple[np.ndarray, ...]], tell: Callable[[float], object]
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Vertices, m, and faces at which the signed distance (positive outside) changes its sign near points.

    `tell` gets the share of the work that is done.
    """
    unit = planes.unit_m
    voxel = _VOXEL * unit
    band = _REACH * unit + 2 * voxel  # wider than the mesh's reach, so that cubes at its rim are complete
    points = planes.points
    corner = points.min(axis=0) - band
    voxels = np.rint((points - corner) / voxel).astype(np.int64)
    order, starts = _sorted(voxels)
    occupied = voxels[order[starts]]
    margin = int(band / voxel) + 1  # one cube more on each side
    bricks = _bricks(occupied, margin)
    vertices, faces, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    done, total = 0, sum(len(members) for _, members in bricks)
    for brick, members in bricks:
        first, last = members.min(axis=0), members.max(axis=0)
        low, high = np.maximum(brick, first - margin), np.minimum(brick + _BRICK, last + margin)
        start, end = np.minimum(low, first), np.maximum(high, last)
        empty = np.ones(end - start + 1, dtype=bool)
        empty[tuple((members - start).T)] = False
        inside = tuple(slice(begin, begin + size) for begin, size in zip(low - start, high - low + 1, strict=True))
        near = (distance_transform_edt(empty, sampling=voxel) <= band)[inside]
        distance = np.full(near.shape, unit)
        distance[near], _ = planes.at((np.argwhere(near) + low) * voxel + corner)
        done += len(members)
        tell(done / total)
        if not distance.min() < 0 < distance.max():
            continue
        try:
            corners, triangles, _, _ = marching_cubes(distance, 0.0, mask=near, allow_degenerate=False)
        except RuntimeError:  # no cube with the surface has all corners near points
            continue
        vertices.append(corners + low.astype(np.float64))
        faces.append(triangles.astype(np.int64) + count)
        count += len(corners)
    joined, owner = _welded(np.concatenate(vertices))
    return joined * voxel + corner, owner[np.concatenate(faces)]


def _sorted(voxels: Int64[np.ndarray, "v 3"]) -> tuple[Int64[np.ndarray, " v"], Int64[np.ndarray, " d"]]:
    """Sorting permutation of rows, and starts of runs of equal rows; ten times as fast as `numpy.unique`."""
    order = np.lexsort(voxels.T[::-1])
    ranked = voxels[order]
    return order, np.flatnonzero(np.append(True, (ranked[1:] != ranked[:-1]).any(axis=1)))


def _bricks(
    occupied: Int64[np.ndarray, "o 3"], margin: int
) -> list[tuple[Int64[np.ndarray, " 3"], Int64[np.ndarray, "n 3"]]]:
    """First voxel of each brick near occupied voxels, and the occupied voxels within `margin` of the brick."""
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


def _welded(vertices: Float64[np.ndarray, "v 3"]) -> tuple[Float64[np.ndarray, "w 3"], Int64[np.ndarray, " v"]]:
    """Merge the vertices (in voxels) that touching bricks share; return them and the new index of each old one.

    An edge between two voxels has one vertex at most, with different rounding in the two bricks.
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
    """Faces whose outer side is turned to the mean direction of the radars that see the place."""
    front = np.empty(len(faces), bool)
    for part in batches(len(faces)):
        a, b, c = np.moveaxis(vertices[faces[part]], 1, 0)
        _, towards = seen.around((a + b + c) / 3)
        front[part] = np.einsum("fc,fc->f", np.cross(b - a, c - a), towards) >= 0
    return faces[front]


def _without_crumbs(
    vertices: Real[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], unit_m: float
) -> tuple[Real[np.ndarray, "w 3"], Int64[np.ndarray, "g 3"]]:
    """Drop small connected parts, and unused vertices."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(ends), bool), tuple(ends.T)), shape=(len(vertices), len(vertices)))
    part = connected_components(links, directed=False)[1][faces[:, 0]]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    area = np.bincount(part, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    faces = faces[area[part] >= min(_SMALLEST_PART * area.sum(), _SMALLEST_UNITS * unit_m**2)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _fitted(
    vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], planes: "Planes"
) -> Iterator[Float64[np.ndarray, "v 3"]]:
    """Vertices, m, after each of `_FIT_ROUNDS` rounds that rotate triangles to the planes' normals.

    Each triangle is rotated about its middle, then vertices get the least-squares fit to all rotated edges (Y. Yu et
    al., "Mesh editing with Poisson-based gradient field manipulation", SIGGRAPH 2004).
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = len(vertices)
    links = csr_array((np.ones(2 * len(start)), (np.append(start, end), np.append(end, start))), shape=(count, count))
    weight = (_FIT_KEPT + links.sum(axis=1))[:, None]
    old = vertices
    for _ in range(_FIT_ROUNDS):
        edges = np.empty((len(faces), 3, 3))
        for batch in batches(len(faces)):
            edges[batch] = _rotated(vertices[faces[batch]], planes)
        rows = edges.reshape(-1, 3)
        pull = np.stack([np.bincount(end, row, count) - np.bincount(start, row, count) for row in rows.T], axis=1)
        for _ in range(_FIT_STEPS):  # Jacobi iteration, which needs no sum over all vertices (bits repeat)
            vertices = (_FIT_KEPT * old + links @ vertices + pull) / weight
        yield vertices


def _rotated(corners: Float64[np.ndarray, "f 3 3"], planes: "Planes") -> Float64[np.ndarray, "f 3 3"]:
    """Edges of triangles, from each corner to the next, rotated to the normals of the planes at their middles."""
    edges = np.roll(corners, -1, axis=1) - corners
    across = np.cross(edges[:, 0], edges[:, 1])
    normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    _, plane_normal = planes.at(corners.mean(axis=1), normal)
    cosine = np.einsum("fc,fc->f", normal, plane_normal)[:, None, None]
    axis = np.cross(normal, plane_normal)[:, None]
    along = (axis * edges).sum(axis=2, keepdims=True)
    return edges * cosine + np.cross(axis, edges) + axis * along / np.maximum(1 + cosine, _FIT_LEAST)


# ---- signed distance ----
@dataclass(frozen=True)
class Planes:
    """Planes of oriented points."""

    points: Float64[np.ndarray, "p 3"]
    """Points, m."""
    unit_m: float
    """Unit of lengths, m: a resolution cell, or more for sparse points."""
    _near: Tree | Neighbours
    _surfels: Surfels
    _near_surfels: Tree | Neighbours

    @classmethod
    def through(
        cls, points: Float64[np.ndarray, "p 3"], normals: Real[np.ndarray, "p 3"], cell_m: float, device: torch.device
    ) -> "Planes":
        """Planes through oriented points, calculated on a device."""
        cloud, sample = torch.from_numpy(points).to(device), slice(None, None, math.ceil(len(points) / _MEASURED))
        near = neighbours_of(cloud)
        spacing = near.nearest(cloud[sample], 2)[0][:, 1].sqrt() if len(points) > 1 else cloud.new_zeros(1)
        unit_m = max(cell_m, _SPACINGS * float(spacing.quantile(0.5)))
        surfels = Surfels.of(cloud, torch.from_numpy(normals).to(cloud), CUBE * unit_m)
        return cls(points, unit_m, near, surfels, neighbours_of(surfels.places))

    def at(
        self, places: Real[np.ndarray, "q 3"], sides: Real[np.ndarray, "q 3"] | None = None
    ) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, "q 3"]]:
        """Signed distances of places from their planes, m, and the planes' unit normals.

        Surfels with normals like the majority, or like `sides` if given, count most.
        """
        results = [np.empty((0, 4))]
        count = _SUMMED if cells.on_cpu(self._surfels.places) else _AT_ONCE
        for first in range(0, len(places), count):
            batch = slice(first, first + count)
            place = torch.from_numpy(places[batch]).to(self._surfels.places)
            side = None if sides is None else torch.from_numpy(sides[batch]).to(place)
            results.append(self._at(place, side).cpu().numpy())
        both = np.concatenate(results)
        return both[:, 0], both[:, 1:]

    def _at(self, places: Float64[Tensor, "q 3"], side: Float64[Tensor, "q 3"] | None) -> Float64[Tensor, "q 4"]:
        """Distance, m, and normal as rows, for a batch of `at`."""
        squared, index = self._near_surfels.nearest(places, min(_NEIGHBOURS, len(self._surfels.places)))
        normals, counts = self._surfels.normals[index], self._surfels.counts[index]
        offsets = dot(places[:, None] - self._surfels.places[index], normals)
        near = counts * torch.exp(-0.5 * (squared - squared[:, :1]) / (_SMOOTHING * self.unit_m) ** 2)
        weight = near
        mean = normalize((near[:, None] @ normals)[:, 0], dim=1) if side is None else side
        for _ in range(_PLANE_ROUNDS):
            difference = 2 - 2 * dot(normals, mean[:, None])  # squared length
            # relative to the smallest, so that weights never vanish
            weight = near * torch.exp((difference.amin(1, keepdim=True) - difference) / _UNLIKE**2)
            mean = normalize((weight[:, None] @ normals)[:, 0], dim=1)
        distance = (weight * offsets).sum(1) / weight.sum(1)
        return torch.cat([distance[:, None], mean], dim=1)

    def distance_m(self, places: Real[np.ndarray, "q 3"]) -> Float64[np.ndarray, " q"]:
        """Distances of places from the nearest point, m."""
        place = torch.from_numpy(places).to(self._surfels.places)
        return self._near.nearest(place, 1)[0][:, 0].sqrt().cpu().numpy()


def batches(count: int) -> Iterator[slice]:
    """Batches of places, to bound memory."""
    return (slice(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE))
