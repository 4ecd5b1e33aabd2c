"""Real spherical harmonics in the order, sign and normalisation of 3D Gaussian splatting's PLY files.

Degree 0:  ½/√π.  Degree 1: (−y, z, −x)·√(3/4π).  Degree 2: (xy, −yz, 3z² − 1, −xz, x² − y²), degree 3:
(−y(3x² − y²), xyz, −y(5z² − 1), z(5z² − 3), −x(5z² − 1), z(x² − y²), −x(x² − 3y²)), each with the constant below.
The Condon–Shortley sign (−1)^m is included. 3DGS evaluates them at the direction *from* the camera, sarsplat at u, the
direction *to* the radar: exports flip the sign of odd degrees.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

_PI = math.pi
CONSTANTS: tuple[float, ...] = (
    0.5 * math.sqrt(1 / _PI),
    *(0.5 * math.sqrt(3 / _PI),) * 3,
    *(0.5 * math.sqrt(15 / _PI),) * 2,
    0.25 * math.sqrt(5 / _PI),
    0.5 * math.sqrt(15 / _PI),
    0.25 * math.sqrt(15 / _PI),
    0.25 * math.sqrt(35 / (2 * _PI)),
    0.5 * math.sqrt(105 / _PI),
    0.25 * math.sqrt(21 / (2 * _PI)),
    0.25 * math.sqrt(7 / _PI),
    0.25 * math.sqrt(21 / (2 * _PI)),
    0.25 * math.sqrt(105 / _PI),
    0.25 * math.sqrt(35 / (2 * _PI)),
)


def harmonic_basis(directions: Float[Tensor, "*n 3"], degree: int) -> Float[Tensor, "*n {(degree+1)**2}"]:
    """Evaluate Y_k(u) at unit vectors, [..., 3] → [..., (degree + 1)²]."""
    x, y, z = torch.unbind(directions, dim=-1)
    one = torch.ones_like(x)
    terms = [
        one,
        *(-y, z, -x),
        *(x * y, -y * z, 3 * z * z - 1, -x * z, x * x - y * y),
        *(-y * (3 * x * x - y * y), x * y * z, -y * (5 * z * z - 1), z * (5 * z * z - 3)),
        *(-x * (5 * z * z - 1), z * (x * x - y * y), -x * (x * x - 3 * y * y)),
    ][: (degree + 1) ** 2]
    return torch.stack([c * t for c, t in zip(CONSTANTS, terms)], dim=-1)
