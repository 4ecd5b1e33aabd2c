"""Rotation and covariance of a Gaussian (docs/concepts/image-model.md §2)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_matrix(quaternions: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices R(q) of quaternions (w, x, y, z), normalised here, [..., 4] → [..., 3, 3]."""
    w, x, y, z = torch.unbind(quaternions / quaternions.norm(dim=-1, keepdim=True), dim=-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rotated(quaternions: Float[Tensor, "*n 4"], vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Rotated vectors R(q) v, [..., 3]; cheaper than by the matrix."""
    w, axis = (quaternions / quaternions.norm(dim=-1, keepdim=True)).split([1, 3], dim=-1)
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)


def product(one: Float[Tensor, "*n 4"], other: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Product of quaternions, that of R(one) R(other), [..., 4]; its norm is the product of both norms."""
    (w, axis), (x, second) = one.split([1, 3], dim=-1), other.split([1, 3], dim=-1)
    vector = w * second + x * axis + torch.linalg.cross(axis, second)
    return torch.cat([w * x - (axis * second).sum(-1, keepdim=True), vector], dim=-1)


def covariance(quaternions: Float[Tensor, "*n 4"], scales: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Covariance matrices Σ = R(q) diag(s²) R(q)ᵀ, m²; [..., 4] and [..., 3] → [..., 3, 3]."""
    root = rotation_matrix(quaternions) * scales[..., None, :]
    return root @ root.transpose(-1, -2)
