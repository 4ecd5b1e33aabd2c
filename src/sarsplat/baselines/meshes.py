"""Closed triangle meshes for DSR: templates of the unit sphere, and losses that fit and smooth meshes.

Each edge of a template's solid is divided into `parts`, then vertices are projected onto the sphere. The published 642
vertices are an icosahedron's with 8 parts, 1,352 a cube's with 15.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sarsplat.baselines.soft_raster import summed


@dataclass(frozen=True, eq=False)
class Template:
    """Closed mesh around the origin."""

    vertices: Float64[np.ndarray, "n 3"]
    """Points of the unit sphere."""
    faces: Int64[np.ndarray, "f 3"]
    """Triangles, counter-clockwise seen from outside."""
    edges: Int64[np.ndarray, "e 2"]
    """Pairs of vertices, each edge once."""
    flaps: Int64[np.ndarray, "e 2"]
    """The two faces at each edge."""


def icosphere(parts: int) -> Template:
    """Subdivided icosahedron: 10·parts² + 2 vertices, 20·parts² faces."""
    golden = (1 + 5**0.5) / 2
    corners = np.array([(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    squared = ((corners[:, None] - corners) ** 2).sum(axis=2)
    near = np.abs(squared - 4) < 1e-9  # edges of length 2
    triangles = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[a, c] and near[b, c]
    ]
    vertices, faces = [], []
    i, j = (index.ravel() for index in np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), indexing="ij"))
    inside = i + j <= parts
    number = np.cumsum(inside).reshape(parts + 1, -1) - 1
    i, j = i[inside], j[inside]
    up = i + j < parts
    down = i + j < parts - 1
    small = np.concatenate(
        [
            np.column_stack([number[i[up], j[up]], number[i[up] + 1, j[up]], number[i[up], j[up] + 1]]),
            np.column_stack(
                [number[i[down] + 1, j[down]], number[i[down] + 1, j[down] + 1], number[i[down], j[down] + 1]]
            ),
        ]
    )
    for count, (a, b, c) in enumerate(triangles):
        weights = np.column_stack([parts - i - j, i, j]) / parts
        vertices.append(weights @ corners[[a, b, c]])
        faces.append(small + count * len(i))
    return _blown_up(np.concatenate(vertices), np.concatenate(faces))


def cube_sphere(parts: int) -> Template:
    """Subdivided cube: 6·parts² + 2 vertices, 12·parts² faces, at equal angles seen from its centre."""
    tangents = np.tan(np.linspace(-np.pi / 4, np.pi / 4, parts + 1))
    u, v = (one.ravel() for one in np.meshgrid(tangents, tangents, indexing="ij"))
    number = np.arange(len(u)).reshape(parts + 1, -1)
    a, b, c, d = (number[k : k + parts, n : n + parts].ravel() for k, n in ((0, 0), (1, 0), (1, 1), (0, 1)))
    small = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    sides = [
        np.roll(np.column_stack([u, v, np.full_like(u, side)]), axis, axis=1) for axis in range(3) for side in (-1, 1)
    ]
    faces = [small + k * len(u) for k in range(6)]
    return _blown_up(np.concatenate(sides), np.concatenate(faces))


def _blown_up(vertices: Float64[np.ndarray, "m 3"], faces: Int64[np.ndarray, "f 3"]) -> Template:
    """Project onto the unit sphere, merge equal vertices, and turn all faces outwards."""
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    _, first, same = np.unique(vertices.round(9) + 0.0, axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], same.reshape(-1)[faces]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inwards = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) < 0
    faces[inwards] = faces[inwards][:, [0, 2, 1]]
    sides = np.sort(np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    order = np.lexsort(sides.T[::-1])
    edges = sides[order[::2]]  # of a closed mesh every edge has two faces
    flaps = (order % len(faces)).reshape(-1, 2)
    return Template(vertices, faces.astype(np.int64), edges.astype(np.int64), flaps.astype(np.int64))


# ---- losses ----------------------------------------------------------------------------------------------------------
def ordered_sum(values: Float[Tensor, "rows columns"]) -> Float[Tensor, ""]:
    """Sum in an order that does not depend on the number of threads."""
    return values.sum(1).cumsum(0)[-1]


def iou_loss(predicted: Float[Tensor, "rows columns"], true: Float[Tensor, "rows columns"]) -> Float[Tensor, ""]:
    """1 − Σ p·t / Σ (p + t − p·t), of masks between 0 and 1; 0 if both are empty."""
    both = ordered_sum(predicted * true)
    either = ordered_sum(predicted + true - predicted * true)
    return 1 - (both + 1e-6) / (either + 1e-6)


def laplacian_loss(vertices: Float[Tensor, "n 3"], edges: Int64[Tensor, "e 2"]) -> Float[Tensor, ""]:
    """Sum over the vertices of the squared distance to the mean of their neighbours."""
    count = len(vertices)
    degree = torch.bincount(edges.reshape(-1), minlength=count).clamp(min=1)
    ends = [gathered(vertices, edges[:, k]) for k in range(2)]
    axis_sums = [
        summed(ends[1][:, k], edges[:, 0], count) + summed(ends[0][:, k], edges[:, 1], count) for k in range(3)
    ]
    offsets = vertices - torch.stack(axis_sums, dim=1) / degree[:, None]
    return ordered_sum(offsets**2)


def flatten_loss(
    vertices: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"], flaps: Int64[Tensor, "e 2"]
) -> Float[Tensor, ""]:
    """Sum over the edges of (1 − cos α)², where α is the angle between the normals of the two faces."""
    normals = face_normals(vertices, faces)
    unit = normals / (normals.square().sum(1, keepdim=True) + 1e-20).sqrt()
    first, second = (gathered(unit, flaps[:, k]) for k in range(2))
    return ordered_sum(((1 - (first * second).sum(1)) ** 2)[:, None])


def face_normals(vertices: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
    """Outward normals, as long as twice the faces' areas."""
    a, b, c = (gathered(vertices, faces[:, k]) for k in range(3))
    return torch.linalg.cross(b - a, c - a, dim=1)


def gathered(rows: Float[Tensor, "n 3"], index: Int64[Tensor, " p"]) -> Float[Tensor, "p 3"]:
    """rows[index]; its gradient is added in a fixed order on the CPU."""
    elements = (3 * index[:, None] + torch.arange(3, device=index.device)).reshape(-1)
    return rows.reshape(-1).index_select(0, elements).reshape(-1, 3)
