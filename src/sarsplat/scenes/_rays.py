"""Parallel rays along the line of sight: a lattice, dense near outlines and sparse in flat patches, and first hits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int32, Int64

from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh, needed
from sarsplat.geometry import View
from sarsplat.scenes._patches import Patches, entered_cells

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

# The ray lattice is rotated by tan⁻¹((√5 − 1)/2), so that its lines are not parallel to an edge of a vehicle at a round
# azimuth: a whole row of rays would cross such an edge at once when the offset changes.
_LATTICE_TILT = math.atan((math.sqrt(5) - 1) / 2)

_RAYS_PER_BATCH = 1 << 20
_MAX_RAYS = 1e8  # maximum number of rays of a view: half a minute

Trace = Callable[[Float64[np.ndarray, "k 2"]], Int32[np.ndarray, " k"]]
"""Function from positions (x_r, y_r) of rays to the first faces that they hit, −1 without a hit."""

_RAYS_PER_SIDE = 8  # rays along each side of a square
_SQUARES_PER_TILE = 128  # squares along each side of a tile
_SQUARES_PER_BATCH = 1 << 12
_FLAT_STEP = 0.2
"""Maximum distance of deposits on a flat patch, relative to the resolution: up to 0.6 images show no moiré, and up to
0.2 shadows stay dark to a thousandth."""


@dataclass(frozen=True)
class Region:
    """Rectangle of the computation plane that rays cover, m."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def empty(self) -> bool:
        return self.x[0] > self.x[1] or self.y[0] > self.y[1]

    def check(self, spacing: float, rays_per_side: int) -> None:
        """Raise if rays, or squares of `rays_per_side`² rays, are too many to trace."""
        height = self.y[1] - self.y[0]
        rays = (self.x[1] - self.x[0]) * height / (spacing * rays_per_side) ** 2
        if rays > _MAX_RAYS:
            raise SarsplatError(
                f"the mesh spans {height:.4g} m of elevation, which needs {rays:.2g} rays {spacing:.4g} m apart; "
                "if it is in millimetres, scale it to metres; otherwise give a larger ray spacing or smaller images"
            )


@dataclass(frozen=True)
class Facets:
    """The mesh in the radar frame: depth of every triangle's plane as z = z0 + slope·(x, y), and its |cos i|."""

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    z0: Float64[np.ndarray, " f"]
    slope: Float64[np.ndarray, "f 2"]
    z_span: Float64[np.ndarray, "2 f"]  # nearest and farthest vertex
    cos_incidence: Float64[np.ndarray, " f"]

    @classmethod
    def of(cls, mesh: Trimesh, view: View) -> Facets:
        vertices = np.asarray(mesh.vertices, dtype=np.float64) @ view.look.frame.T
        faces = np.asarray(mesh.faces, dtype=np.int32)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        # A triangle seen exactly edge-on has no slope, and no ray hits it.
        seen = normal[:, 2] != 0
        slope = -np.divide(normal[:, :2], normal[:, 2:], where=seen[:, None], out=np.zeros((len(faces), 2)))
        cos_incidence = np.abs(np.divide(normal[:, 2], length, where=seen, out=np.zeros(len(faces))))
        depths = vertices[faces, 2]
        z0 = a[:, 2] - (slope * a[:, :2]).sum(axis=1)
        return cls(vertices, faces, z0, slope, np.stack([depths.min(axis=1), depths.max(axis=1)]), cos_incidence)

    def depth(self, face: Int32[np.ndarray, " k"], position: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, " k"]:
        """Return the range z_r of faces [K] at positions (x_r, y_r) [K, 2], clipped to each triangle's range."""
        # In float64 from the plane, not from the intersector's float32; the clip limits planes seen almost edge-on.
        z = self.z0[face] + (self.slope[face] * position).sum(axis=1)
        return np.clip(z, *self.z_span[:, face])


def first_hits(
    facets: Facets, azimuth_reach: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[tuple[Float64[np.ndarray, "k 2"], Int32[np.ndarray, " k"]]]:
    """Yield rays that hit the mesh in batches: positions (x_r, y_r) float64 [K, 2] and first-hit faces [K]."""
    lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
    region = Region(
        (max(lower[0], azimuth_reach[0]), min(upper[0], azimuth_reach[1])), (float(lower[1]), float(upper[1]))
    )
    if region.empty:
        return
    region.check(spacing, 1)
    trace = tracer(facets)
    for position in _lattice(region.x, region.y, spacing, offset):
        face = trace(position)
        hit = face >= 0
        yield position[hit], face[hit]


def turned(points: Float64[np.ndarray, "k 2"], back: bool = False) -> Float64[np.ndarray, "k 2"]:
    """Rotate points from the axes of the lattice to (x_r, y_r), or `back`."""
    cos, sin = math.cos(_LATTICE_TILT), math.sin(_LATTICE_TILT)
    turn = np.array([[cos, sin], [-sin, cos]])
    return points @ (turn.T if back else turn)


def embree_scene(
    vertices: Float64[np.ndarray, "v 3"], faces: Int32[np.ndarray, "f 3"]
) -> tuple[EmbreeScene, Float64[np.ndarray, " 3"]]:
    """Make a scene of a mesh for rays, and return its origin, the middle of the mesh; needs embreex."""
    with needed("simulate", "ray casting"):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2  # float32 keeps the most digits around zero
    scene = EmbreeScene(robust=True)  # watertight along shared edges
    TriangleMesh(scene=scene, vertices=(vertices - center).astype(np.float32), indices=faces)
    return scene, center


def tracer(facets: Facets) -> Trace:
    """Make the function that traces rays along the line of sight; needs embreex."""
    scene, center = embree_scene(facets.vertices, facets.faces)
    direction = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    start = facets.vertices[:, 2].min() - 1.0

    def trace(position: Float64[np.ndarray, "k 2"]) -> Int32[np.ndarray, " k"]:
        origins = np.empty((len(position), 3), dtype=np.float32)
        origins[:, :2] = position - center[:2]
        origins[:, 2] = start - center[2]
        return scene.run(origins, direction)

    return trace


def _lattice(
    x: tuple[float, float], y: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[Float64[np.ndarray, "k 2"]]:
    """Yield points of the tilted square lattice within a rectangle in batches, float64 [K, 2]."""
    corners = turned(np.array([(a, b) for a in x for b in y]), back=True) / spacing - offset
    first, last = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    along = np.arange(first[0], last[0] + 1) + offset[0]
    lines_per_batch = max(1, _RAYS_PER_BATCH // len(along))
    for start in range(first[1], last[1] + 1, lines_per_batch):
        across = np.arange(start, min(start + lines_per_batch, last[1] + 1)) + offset[1]
        u, v = np.meshgrid(along, across)
        position = turned(spacing * np.column_stack([u.ravel(), v.ravel()]))
        inside = ((position >= (x[0], y[0])) & (position <= (x[1], y[1]))).all(axis=1)
        yield position[inside]


@dataclass(frozen=True)
class Hits:
    """First hits of rays, each representing an area across the line of sight."""

    position: Float64[np.ndarray, "k 2"]  # (x_r, y_r), m
    slant_range: Float64[np.ndarray, " k"]  # z_r, m
    face: Int32[np.ndarray, " k"]
    area: float | Float64[np.ndarray, " k"]  # m²


@dataclass(frozen=True)
class Lattice:
    """Lattice of rays onto the patches of a mesh, for images of one resolution."""

    patches: Patches
    spacing: float  # near outlines, m
    offset: tuple[float, float]  # along both axes, in spacings
    resolution: tuple[float, float]  # azimuth and range, m


def sparse_hits(
    lattice: Lattice,
    facets: Facets,
    trace: Trace,
    region: Region,
    least_slope: float,
    progress: Callable[[float], object],
) -> Iterator[Hits]:
    """Yield first hits in a region: a spacing apart near outlines of patches, sparser within them.

    The region is divided into squares of 8 × 8 rays. A square without outlines whose corners see the same patch needs
    no further ray: it is split into as many parts as the slope of the patch, or `least_slope` along y_r, needs to look
    continuous at the resolution (azimuth, range). Other squares get all of their rays. `progress` is called with the
    finished share.
    """
    patches, spacing, offset, resolution = lattice.patches, lattice.spacing, lattice.offset, lattice.resolution
    side = _RAYS_PER_SIDE * spacing
    origin = np.array(offset) - 0.5

    def position(square: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
        return turned(spacing * (_RAYS_PER_SIDE * square + origin))

    def square(position: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
        return (turned(position, back=True) / spacing - origin) / _RAYS_PER_SIDE

    region.check(spacing, _RAYS_PER_SIDE)
    (left, right), (low, high) = region.x, region.y
    bounds = square(np.array([(x, y) for x in region.x for y in region.y]))
    first = np.floor(bounds.min(axis=0)).astype(np.int64)
    columns, rows = (int(count) for count in np.ceil(bounds.max(axis=0)).astype(np.int64) - first)
    vertices, edges = square(facets.vertices[:, :2]) - first, patches.outlines_from(facets.vertices[:, :2])
    outlined = entered_cells(vertices[edges[:, 0]], vertices[edges[:, 1]], (max(rows, 1), max(columns, 1)))
    axes = turned(np.eye(2))  # unit vectors along the sides of squares
    slopes = np.maximum(np.abs(facets.slope[patches.largest_face] @ axes.T), least_slope * np.abs(axes[:, 1]))
    steps = side * np.maximum(slopes / resolution[1], np.abs(axes[:, 0]) / resolution[0])
    parts = np.clip(np.ceil(steps / _FLAT_STEP), 1, _RAYS_PER_SIDE).astype(np.int64)  # along sides, of each patch
    tiles = [
        (row, column) for row in range(0, rows, _SQUARES_PER_TILE) for column in range(0, columns, _SQUARES_PER_TILE)
    ]
    for done, (row, column) in enumerate(tiles):
        progress(done / len(tiles))
        tile = outlined[row : row + _SQUARES_PER_TILE, column : column + _SQUARES_PER_TILE]
        v, u = np.mgrid[: tile.shape[0] + 1, : tile.shape[1] + 1] + np.array([row, column])[:, None, None]
        corners = position(np.stack([u, v], axis=-1).reshape(-1, 2) + first)
        if (corners.max(axis=0) < (left, low)).any() or (corners.min(axis=0) > (right, high)).any():
            continue
        face = trace(corners)
        hit_patch = np.where(face >= 0, patches.of_face[face], -1).reshape(u.shape)
        patch = hit_patch[:-1, :-1]
        uniform = (patch == hit_patch[1:, :-1]) & (patch == hit_patch[:-1, 1:]) & (patch == hit_patch[1:, 1:]) & ~tile
        squares = np.stack([u[:-1, :-1], v[:-1, :-1]], axis=-1) + first
        flat = uniform & (patch >= 0)
        if flat.any():
            patch = patch[flat]
            centers, owner = _centers(squares[flat], parts[patch])
            at, face = position(centers), patches.largest_face[patch][owner]
            slant_range = facets.z0[face] + (facets.slope[face] * at).sum(axis=1)
            yield Hits(at, slant_range, face.astype(np.int32), (side**2 / parts.prod(axis=1))[patch][owner])
        mixed = squares[~uniform]
        for begin in range(0, len(mixed), _SQUARES_PER_BATCH):
            at = position(_centers(mixed[begin : begin + _SQUARES_PER_BATCH], np.full(2, _RAYS_PER_SIDE))[0])
            face = trace(at)
            hit = face >= 0
            at, face = at[hit], face[hit]
            yield Hits(at, facets.depth(face, at), face, spacing**2)
    progress(1.0)


def _centers(
    squares: Int64[np.ndarray, "k 2"], parts: Int64[np.ndarray, "*k 2"]
) -> tuple[Float64[np.ndarray, "n 2"], Int64[np.ndarray, " n"]]:
    """Return the centres of the parts of squares, in sides, and the square of each part."""
    parts = np.broadcast_to(parts, squares.shape)
    count = parts.prod(axis=1)
    square = np.repeat(np.arange(len(squares)), count)
    number = np.arange(len(square)) - np.repeat(np.cumsum(count) - count, count)
    along, across = parts[square].T
    row, column = np.divmod(number, along)
    within = np.column_stack([(column + 0.5) / along, (row + 0.5) / across])
    return squares[square] + within, square
