"""Closed bodies, possibly intersecting, from which vehicles are assembled; all lengths in metres.

Pairs of coordinates are in either order, so that (side * a, side * b) serves both sides of a vehicle.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import numpy as np
from jaxtyping import Int

from sarsplat.extras import Trimesh

Pair = tuple[float, float]
Point = tuple[float, float, float]


def assembled(parts: Sequence[Trimesh]) -> Trimesh:
    """One mesh of many bodies."""
    import trimesh

    return cast(Trimesh, trimesh.util.concatenate(parts))


def box(x: Pair, y: Pair, z: Pair) -> Trimesh:
    """Box between pairs of coordinates."""
    import trimesh

    return trimesh.creation.box(bounds=np.sort(np.array([x, y, z], dtype=float)).T)


def hull(points: Sequence[Point]) -> Trimesh:
    """Convex hull of points."""
    import trimesh

    return trimesh.convex.convex_hull(np.array(points, dtype=float))


def prism(profile: Sequence[Pair], y: Pair) -> Trimesh:
    """Convex side profile of (x, z) points, extruded along y."""
    return hull([(px, side, pz) for px, pz in profile for side in sorted(y)])


def mirrored(*points: Point) -> Trimesh:
    """Convex hull of points and their mirror images on the other side of the vehicle."""
    return hull([*points, *((x, -y, z) for x, y, z in points)])


def strip(path: Sequence[Pair], thickness: float, y: Pair) -> list[Trimesh]:
    """Plates along a path of (x, z) points, such as a mudguard: one per segment, of a thickness measured in z."""
    return [
        prism([(xa, za), (xa, za + thickness), (xb, zb), (xb, zb + thickness)], y)
        for (xa, za), (xb, zb) in pairwise(path)
    ]


def cylinder(radius: float, start: Point, end: Point, sections: int = 24) -> Trimesh:
    """Circular cylinder around the axis from `start` to `end`."""
    import trimesh

    return trimesh.creation.cylinder(radius=radius, segment=np.array([start, end], dtype=float), sections=sections)


def revolved(profile: Sequence[Pair], sections: int = 32) -> Trimesh:
    """Body of revolution around z: (radius, height) points from axis to axis, counter-clockwise (bottom first)."""
    import trimesh

    return trimesh.creation.revolve(np.array(profile, dtype=float), sections=sections)


def barrel(profile: Sequence[Pair], root: Point, elevation_deg: float, sections: int = 20) -> Trimesh:
    """Gun barrel from `root` forwards and upwards: (radius, distance from the root) points from axis to axis."""
    import trimesh

    body = revolved(profile, sections)
    tilt = trimesh.transformations.rotation_matrix(math.radians(90 - elevation_deg), (0, 1, 0))
    tilt[:3, 3] = np.array(root)
    body.apply_transform(tilt)
    return body


def wheel(x: float, y: Pair, radius: float, rim: float, z: float | None = None) -> Trimesh:
    """Tyred wheel between two values of y: round shoulders, sunk disc of the share `rim` of the radius, standing hub.

    It stands on the ground unless the height of its axle is given.
    """
    half = abs(y[1] - y[0]) / 2
    side = [
        (0.0, 0.85), (0.22, 0.85), (0.26, 0.5), (rim, 0.6), (rim + 0.06, 0.92), (0.78, 1.0), (0.92, 0.92), (1.0, 0.68)
    ]  # fmt: skip
    points = [(r * radius, -h * half) for r, h in side] + [(r * radius, h * half) for r, h in side[::-1]]
    body = revolved(points)
    body.vertices = body.vertices[:, [0, 2, 1]] * (1, -1, 1) + (x, sum(y) / 2, radius if z is None else z)
    return body


def belt(wheels: Sequence[tuple[float, float, float]], thickness: float, y: Pair) -> Trimesh:
    """Closed belt with edges at y around wheels (x, z, radius) that touch its inner side, such as a track."""
    import trimesh

    sections = 96  # normal directions sampled around it; a multiple of four includes straight down
    # The support point of a union of discs in direction d is c + r·d of the disc with the largest c·d + r; the same
    # disc supports the thickened belt, so inner and outer points pair up.
    circles = np.array(wheels)
    angles = np.arange(sections) * (2 * math.pi / sections)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    support = circles[(normals @ circles[:, :2].T + circles[:, 2]).argmax(axis=1)]
    inner = support[:, :2] + support[:, 2:] * normals
    outer = inner + thickness * normals
    # The four edges of the belt's rectangular section, in order around it: each neighbouring pair spans one face strip.
    low, high = sorted(y)
    corners = [(inner, low), (inner, high), (outer, high), (outer, low)]
    vertices = np.concatenate([np.column_stack([p[:, 0], np.full(sections, side), p[:, 1]]) for p, side in corners])
    faces = [half for edge in range(4) for half in faces_between(edge, (edge + 1) % 4, sections)]
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def faces_between(ring: int, next_ring: int, sections: int) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
    """Both halves of the quadrilaterals between two closed rings with vertices numbered ring by ring."""
    here = np.arange(sections)
    after = np.roll(here, -1)
    a, b = ring * sections, next_ring * sections
    return np.column_stack([a + here, b + after, b + here]), np.column_stack([a + here, a + after, b + after])
