"""Parallel rays along the line of sight: the lattice on which they stand, and what each meets first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int32

from sarsplat.errors import SarsplatError
from sarsplat.geometry import View

if TYPE_CHECKING:
    import trimesh

# The ray lattice is rotated by tan⁻¹((√5 − 1)/2), so that its lines are not parallel to an edge of a vehicle at a round
# azimuth: a whole row of rays would cross such an edge at once when the offset changes.
_LATTICE_TILT = math.atan((math.sqrt(5) - 1) / 2)

_RAYS_PER_BATCH = 1 << 20
_MAX_RAYS = 1e8  # half a minute a view

Trace = Callable[[Float64[np.ndarray, "k 2"]], Int32[np.ndarray, " k"]]
"""From positions (x_r, y_r) to the first faces that rays there meet, −1 for none."""


@dataclass(frozen=True)
class Region:
    """Part of the computation plane on which rays stand, m."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def empty(self) -> bool:
        return self.x[0] > self.x[1] or self.y[0] > self.y[1]

    def check(self, spacing: float, rays_per_side: int) -> None:
        """Refuse more rays, or squares of this many rays along a side, than can be traced."""
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
    def of(cls, mesh: trimesh.Trimesh, view: View) -> Facets:
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
        """Range z_r of the planes of faces [K] at positions (x_r, y_r) [K, 2], kept within each triangle."""
        # In float64 from the plane, not from the intersector's float32; the clip tames planes seen almost edge-on.
        z = self.z0[face] + (self.slope[face] * position).sum(axis=1)
        return np.clip(z, *self.z_span[:, face])


def first_hits(
    facets: Facets, azimuth_reach: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[tuple[Float64[np.ndarray, "k 2"], Int32[np.ndarray, " k"]]]:
    """Batches of rays that hit the mesh: positions (x_r, y_r) float64 [K, 2] and first-hit faces [K]."""
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
    """Points along the axes of the lattice as (x_r, y_r), or `back`."""
    cos, sin = math.cos(_LATTICE_TILT), math.sin(_LATTICE_TILT)
    turn = np.array([[cos, sin], [-sin, cos]])
    return points @ (turn.T if back else turn)


def tracer(facets: Facets) -> Trace:
    """What rays along the line of sight meet first; needs embreex."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise SarsplatError("ray casting needs embreex; install it with: pip install 'sarsplat[simulate]'") from error
    lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
    center = (lower + upper) / 2  # float32 keeps the most digits around zero
    scene = EmbreeScene(robust=True)  # watertight along shared edges
    TriangleMesh(scene=scene, vertices=(facets.vertices - center).astype(np.float32), indices=facets.faces)
    direction = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    before = lower[2] - 1.0

    def trace(position: Float64[np.ndarray, "k 2"]) -> Int32[np.ndarray, " k"]:
        origins = np.empty((len(position), 3), dtype=np.float32)
        origins[:, :2] = position - center[:2]
        origins[:, 2] = before - center[2]
        return scene.run(origins, direction)

    return trace


def _lattice(
    x: tuple[float, float], y: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[Float64[np.ndarray, "k 2"]]:
    """Points of the tilted square lattice within a rectangle, in batches, float64 [K, 2]."""
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
