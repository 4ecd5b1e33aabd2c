"""Closed primitive bodies that vehicles are put together from; all lengths in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

Point = tuple[float, float, float]


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> trimesh.Trimesh:
    """Box between pairs of coordinates."""
    import trimesh

    return trimesh.creation.box(bounds=np.array([x, y, z], dtype=float).T)


def hull(points: Sequence[Point]) -> trimesh.Trimesh:
    """Convex hull of points."""
    import trimesh

    return trimesh.convex.convex_hull(np.array(points, dtype=float))


def prism(profile: Sequence[tuple[float, float]], y: tuple[float, float]) -> trimesh.Trimesh:
    """Convex side profile of (x, z) points, drawn out along y."""
    return hull([(px, side, pz) for px, pz in profile for side in y])


def cylinder(radius: float, start: Point, end: Point, sections: int = 24) -> trimesh.Trimesh:
    """Circular cylinder around the axis from `start` to `end`."""
    import trimesh

    return trimesh.creation.cylinder(radius=radius, segment=np.array([start, end], dtype=float), sections=sections)


def revolved(profile: Sequence[tuple[float, float]], sections: int = 32) -> trimesh.Trimesh:
    """Body of revolution around z: (radius, height) points from axis to axis, counter-clockwise (bottom first)."""
    import trimesh

    return trimesh.creation.revolve(np.array(profile, dtype=float), sections=sections)


def belt(
    wheels: Sequence[tuple[float, float, float]], thickness: float, y: tuple[float, float], sections: int = 96
) -> trimesh.Trimesh:
    """Closed belt stretched around wheels, such as a track.

    Parameters
    ----------
    wheels : sequence of (x, z, radius)
        Circles that the belt's inner side touches.
    thickness : float
        Thickness of the belt.
    y : (float, float)
        Its two edges.
    sections : int
        Number of normal directions sampled around it; a multiple of four includes straight down.
    """
    import trimesh

    # The support point of a union of discs in direction d is c + r·d of the disc with the largest c·d + r; the same
    # disc supports the thickened belt, so inner and outer points pair up.
    circles = np.array(wheels)
    angles = np.arange(sections) * (2 * math.pi / sections)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    support = circles[(normals @ circles[:, :2].T + circles[:, 2]).argmax(axis=1)]
    inner = support[:, :2] + support[:, 2:] * normals
    outer = inner + thickness * normals
    # The four edges of the belt's rectangular section, in order around it: each neighbouring pair spans one face strip.
    corners = [(inner, y[0]), (inner, y[1]), (outer, y[1]), (outer, y[0])]
    vertices = np.concatenate([np.column_stack([p[:, 0], np.full(sections, side), p[:, 1]]) for p, side in corners])
    here = np.arange(sections)
    after = np.roll(here, -1)
    faces = []
    for edge in range(4):
        a, b = edge * sections, (edge + 1) % 4 * sections
        faces += [np.column_stack([a + here, b + after, b + here]), np.column_stack([a + here, a + after, b + after])]
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
