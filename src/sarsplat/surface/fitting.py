"""Triangles turned to the normals that the points around them have, and their vertices moved together again.

After Y. Yu et al., "Mesh editing with Poisson-based gradient field manipulation", SIGGRAPH 2004: where each triangle
would be if it were turned about its middle, vertices fit the edges of all triangles around them best.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array

from sarsplat.surface.planes import Planes, some_at_a_time

ROUNDS = 2
_STEPS = 40
_KEPT = 0.5  # weight of a vertex's old place, beside that of an edge
_LEAST = 0.2  # 1 + cosine of the turn, at least: nothing is turned over


def fitted(
    vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], planes: Planes
) -> Iterator[Float64[np.ndarray, "v 3"]]:
    """The vertices, m, after each of `ROUNDS` rounds."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = len(vertices)
    links = csr_array((np.ones(2 * len(start)), (np.append(start, end), np.append(end, start))), shape=(count, count))
    weight = (_KEPT + links.sum(axis=1))[:, None]
    old = vertices
    for _ in range(ROUNDS):
        edges = np.empty((len(faces), 3, 3))
        for some in some_at_a_time(len(faces)):
            edges[some] = _turned(vertices[faces[some]], planes)
        rows = edges.reshape(-1, 3)
        pull = np.stack([np.bincount(end, row, count) - np.bincount(start, row, count) for row in rows.T], axis=1)
        for _ in range(_STEPS):  # Jacobi's: without sums over all vertices, whose order would depend on threads
            vertices = (_KEPT * old + links @ vertices + pull) / weight
        yield vertices


def _turned(corners: Float64[np.ndarray, "f 3 3"], planes: Planes) -> Float64[np.ndarray, "f 3 3"]:
    """Edges of triangles, from each corner to the next, turned to the normals of the planes there."""
    edges = np.roll(corners, -1, axis=1) - corners
    across = np.cross(edges[:, 0], edges[:, 1])
    normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    _, wanted = planes.at(corners.mean(axis=1), normal)
    cosine, axis = np.einsum("fc,fc->f", normal, wanted)[:, None, None], np.cross(normal, wanted)[:, None]
    along = (axis * edges).sum(axis=2, keepdims=True)
    return edges * cosine + np.cross(axis, edges) + axis * along / np.maximum(1 + cosine, _LEAST)
