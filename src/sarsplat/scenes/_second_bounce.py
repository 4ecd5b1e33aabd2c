"""Second bounces of a mesh: facet and level ground, or facet and facet; every leg is traced.

A small rough facet of area A and normal n has the cross-section γ(|n·h|)·A·√((n·a)(n·b)) from direction a to b, with
the bisector h of both and γ of the `ScatteringLaw`; this is γ⁰·A·cos i where a = b. The ground is a mirror with |Γ|² of
the power. Every path is also travelled backwards, over the same length, so its amplitude counts twice and its power
four times.

Rays find a point of the surface directly from the radar or as the second point of a path. Samples are weighted by the
probability of both together (multiple importance sampling), so that no sample weighs more than its patch.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from sarsplat.extras import Trimesh
from sarsplat.geometry import View
from sarsplat.scenes._deposit import Deposit, NodeGrid
from sarsplat.scenes._rays import Facets, Lattice, Region, Trace, embree_scene, sparse_hits
from sarsplat.scenes.scattering import ScatteringLaw

Points = Float64[np.ndarray, "k 3"]

BY_GROUND, BETWEEN_FACETS = "by way of the ground", "between facets"
"""Names of the kinds of second bounces."""

_LIFT = 1e-5  # distance of the start of a leg from the surface, relative to the mesh: a hundred roundings of float32
_COHERENT = 4.0  # power of two equal amplitudes (both senses of a path), relative to one
_DIRECTIONS = 4  # directions from facet to facet for each square between rays
_STEEPEST = 1.0  # `least_slope` of `sparse_hits`, because the foot of a point moves with its elevation
_EVENLY = 0.7548776662466927, 0.5698402909980532
"""Steps a, b from the plastic number: points (i a, i b) modulo 1 fill the unit square evenly."""


@dataclass(frozen=True)
class _Points:
    """Points of the surface hit by rays from one direction."""

    position: Points
    normal: Points  # towards that direction
    face: Int32[np.ndarray, " k"]
    area: Float64[np.ndarray, " k"]  # across that direction, m²

    def __getitem__(self, which: np.ndarray) -> "_Points":
        return _Points(self.position[which], self.normal[which], self.face[which], self.area[which])


class SecondBounce:
    """Second bounces of one mesh, without ground, from any views.

    `law` is γ of its facets, and `factors` the factor of each. `ground_reflectivity` is |Γ|² of level ground at z = 0;
    None where there is no ground.
    """

    def __init__(
        self,
        mesh: Trimesh,
        law: ScatteringLaw,
        factors: Float64[np.ndarray, " f"],
        lattice: Lattice,
        ground_reflectivity: float | None,
    ) -> None:
        self._mesh, self._law, self._factors, self._lattice = mesh, law, factors, lattice
        self._reflectivity = ground_reflectivity
        self._mirrored = mesh.copy()
        self._mirrored.vertices = np.asarray(mesh.vertices) * (1.0, 1.0, -1.0)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        self._normals = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)

    def images(
        self, view: View, facets: Facets, trace: Trace, nodes: NodeGrid, progress: Callable[[float], object]
    ) -> dict[str, Float64[np.ndarray, "rows columns"]]:
        """Return β⁰ by kind; `facets` and `trace` are those of the rays from the radar."""
        kinds = {BY_GROUND: self.by_ground} if self._reflectivity else {}
        kinds |= {BETWEEN_FACETS: self.between_facets}
        images = {}
        for done, (kind, add) in enumerate(kinds.items()):
            deposit = Deposit(nodes)
            add(view, facets, trace, deposit, lambda share, done=done: progress((done + share) / len(kinds)))  # type: ignore[misc]
            images[kind] = deposit.image
        return images

    # ---- facet and ground --------------------------------------------------------------------------------------------
    def by_ground(
        self, view: View, facets: Facets, trace: Trace, deposit: Deposit, progress: Callable[[float], object]
    ) -> None:
        """Deposit facet–ground and ground–facet paths: a point is imaged at its foot on the ground, at any height."""
        look, legs = view.look, _Legs(self._mesh)
        u = look.facing
        mirrored, bisector = u * (1.0, 1.0, -1.0), np.array([u[0], u[1], 0.0]) / math.hypot(u[0], u[1])

        def add(points: _Points, incoming: Points, outgoing: Points) -> None:
            p, q = points.normal @ incoming, points.normal @ outgoing
            gamma = self._factors[points.face] * self._law.gamma0(points.normal @ bisector)
            share = _COHERENT * (self._reflectivity or 0.0) * gamma * np.sqrt(p * q) / (p + q)
            azimuth, slant_range = look.gradients[:, :2] @ points.position[:, :2].T
            deposit.add(azimuth, slant_range, share * points.area)

        for points in self._found(facets, trace, view, u, lambda share: progress(share / 2)):
            points = points[(points.position[:, 2] > legs.lift) & (points.normal @ mirrored > 0)]
            length = points.position[:, 2] / u[2]
            feet = points.position + length[:, None] * mirrored
            free = legs.free(points.position + legs.lift * points.normal, mirrored, length)
            free &= legs.free(legs.above(feet), u)
            add(points[free], u, mirrored)

        image = Facets.of(self._mirrored, view)  # mirror image in the ground

        def by_mirror(position: Float64[np.ndarray, "k 2"]) -> Int32[np.ndarray, " k"]:
            ground = np.column_stack([position, look.range_on_ground(*position.T)]) @ look.frame
            face = legs.first(legs.above(ground), -mirrored)
            hit = np.flatnonzero(face >= 0)
            face[hit[~legs.free(legs.above(ground[hit]), u)]] = -1
            return face

        for points in self._found(image, by_mirror, view, u, lambda share: progress((1 + share) / 2), (1.0, 1.0, -1.0)):
            points = points[(points.position[:, 2] > legs.lift) & (points.normal @ u > 0)]
            free = legs.free(points.position + legs.lift * points.normal, u)
            add(points[free], mirrored, u)

    # ---- facet and facet ---------------------------------------------------------------------------------------------
    def between_facets(
        self, view: View, facets: Facets, trace: Trace, deposit: Deposit, progress: Callable[[float], object]
    ) -> None:
        """Deposit paths from one rough facet to another, in directions spread evenly over the first's half space."""
        look, legs, count = view.look, _Legs(self._mesh), 0
        u = look.facing
        for points in self._found(facets, trace, view, u, progress):
            directions = np.maximum(np.rint(_DIRECTIONS * points.area / self._lattice.spacing**2), 1).astype(np.int64)
            points = points[np.repeat(np.arange(len(directions)), directions)]
            area = points.area / np.repeat(directions, directions)
            number = count + np.arange(len(points.face))
            count += len(number)
            away = _half_sphere(
                points.normal, *((number * step + at) % 1 for step, at in zip(_EVENLY, self._lattice.offset))
            )
            face = legs.first(points.position + legs.lift * points.normal, away)
            hit = face >= 0
            points, area, away, face = points[hit], area[hit], away[hit], face[hit]
            normal = self._normals[face]
            facing = -(normal * away).sum(axis=1)
            normal, facing = normal * np.sign(facing)[:, None], np.abs(facing)
            corner = np.asarray(self._mesh.vertices, dtype=np.float64)[np.asarray(self._mesh.faces)[face, 0]]
            length = -(((corner - points.position) * normal).sum(axis=1)) / np.maximum(facing, 1e-12)
            second = points.position + length[:, None] * away
            visible = (normal @ u > 0) & (facing > 1e-6) & (length > 0)
            if self._reflectivity is not None:
                visible &= second[:, 2] > 0
            visible[visible] = legs.free(second[visible] + legs.lift * normal[visible], u)
            points, area, away, face = points[visible], area[visible], away[visible], face[visible]
            normal, facing, length, second = normal[visible], facing[visible], length[visible], second[visible]
            p, q = (points.normal @ u) * facing, (normal @ u) * (points.normal * away).sum(axis=1)
            gamma = self._gamma(points.face, points.normal, u + away) * self._gamma(face, normal, u - away)
            # twice for the amplitude of both senses; a direction represents 2π, and a cross-section spreads over 4π
            section = 2 * area * gamma * np.sqrt(p * q) / (p + q)
            middle = (points.position + second) / 2
            azimuth, slant_range = look.gradients @ middle.T
            deposit.add(azimuth, slant_range + length / 2, section)

    def _gamma(self, face: Int32[np.ndarray, " k"], normal: Points, total: Points) -> Float64[np.ndarray, " k"]:
        """Return γ of facets between two directions with this sum."""
        return self._factors[face] * self._law.gamma0((normal * total).sum(axis=1) / np.linalg.norm(total, axis=1))

    def _found(
        self,
        facets: Facets,
        trace: Trace,
        view: View,
        u: Float64[np.ndarray, " 3"],
        progress: Callable[[float], object],
        turned: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> Iterator[_Points]:
        """Yield points hit by rays along the line of sight; `turned` is the reflection from `facets` to the world."""
        low, high = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
        region = Region((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))
        for hits in sparse_hits(self._lattice, facets, trace, region, _STEEPEST, progress):
            position = np.column_stack([hits.position, hits.slant_range]) @ view.look.frame * turned
            normal = self._normals[hits.face]
            side = np.sign(normal @ (u * turned))
            area = np.broadcast_to(np.asarray(hits.area), side.shape)
            yield _Points(position, normal * side[:, None], hits.face, area)[side != 0]


class _Legs:
    """Rays from points of a mesh: occlusion tests and first hits; needs embreex."""

    def __init__(self, mesh: Trimesh) -> None:
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        self.lift = _LIFT * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self._scene, self._center = embree_scene(vertices, np.asarray(mesh.faces, dtype=np.int32))

    def first(self, origin: Points, direction: Float64[np.ndarray, "*k 3"]) -> Int32[np.ndarray, " k"]:
        """Return the first faces hit, −1 without a hit."""
        return np.asarray(self._scene.run(*self._rays(origin, direction)))

    def free(
        self, origin: Points, direction: Float64[np.ndarray, "*k 3"], length: Float64[np.ndarray, " k"] | None = None
    ) -> Bool[np.ndarray, " k"]:
        """Return True for unoccluded rays, of this length if it is given."""
        until = None if length is None else length.astype(np.float32)
        return np.asarray(self._scene.run(*self._rays(origin, direction), until, "OCCLUDED")) < 0

    def above(self, ground: Points) -> Points:
        """Lift points of the ground by `lift`."""
        return ground + np.array([0.0, 0.0, self.lift])

    def _rays(self, origin: Points, direction: Float64[np.ndarray, "*k 3"]) -> tuple[np.ndarray, np.ndarray]:
        return (origin - self._center).astype(np.float32), np.atleast_2d(direction).astype(np.float32)


def _half_sphere(normal: Points, height: Float64[np.ndarray, " k"], turn: Float64[np.ndarray, " k"]) -> Points:
    """Return unit vectors with these cosines to the normals, rotated about them by these parts of a turn."""
    sign = np.where(normal[:, 2] >= 0, 1.0, -1.0)  # a basis across the normal that is stable at both poles
    x, y, z = normal.T
    a = -1 / (sign + z)
    b = x * y * a
    first = np.column_stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = np.column_stack([b, sign + y * y * a, -y])
    across = np.sqrt(1 - height**2)
    u, v = (across * np.cos(2 * math.pi * turn))[:, None], (across * np.sin(2 * math.pi * turn))[:, None]
    return u * first + v * second + height[:, None] * normal
