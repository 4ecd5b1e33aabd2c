"""Losses of DSR: regularisers of the mesh, and the distance of soft masks from true ones."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sarsplat.baselines.soft_raster import summed


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
