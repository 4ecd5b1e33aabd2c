"""γ⁰ in real spherical harmonics, in the order, sign and normalisation of 3D Gaussian splatting's PLY files.

Degree 0:  ½/√π.  Degree 1: (−y, z, −x)·√(3/4π).  Degree 2: (xy, −yz, 3z² − 1, −xz, x² − y²), degree 3:
(−y(3x² − y²), xyz, −y(5z² − 1), z(5z² − 3), −x(5z² − 1), z(x² − y²), −x(x² − 3y²)), each with the constant below.
The Condon–Shortley sign (−1)^m is included. 3DGS evaluates them at the direction *from* the camera, sarsplat at u, the
direction *to* the radar: exports flip the sign of odd degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from sarsplat.gaussians.scattering import Scattering, softplus, softplus_inverse

CONSTANTS: tuple[float, ...] = (
    0.5 * math.sqrt(1 / math.pi),
    *(0.5 * math.sqrt(3 / math.pi),) * 3,
    *(0.5 * math.sqrt(15 / math.pi),) * 2,
    0.25 * math.sqrt(5 / math.pi),
    0.5 * math.sqrt(15 / math.pi),
    0.25 * math.sqrt(15 / math.pi),
    0.25 * math.sqrt(35 / (2 * math.pi)),
    0.5 * math.sqrt(105 / math.pi),
    0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(7 / math.pi),
    0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(105 / math.pi),
    0.25 * math.sqrt(35 / (2 * math.pi)),
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


@dataclass(frozen=True)
class Harmonics(Scattering):
    """Real spherical harmonics: γ⁰(u) = p_min + softplus(Σ_k parameters_k Y_k(u)).

    `parameters` is [N, K] with K = (degree + 1)², degree ≤ 3; order and signs are those of 3D Gaussian splatting
    (docs/concepts/image-model.md). See also `Scattering`.
    """

    kind: ClassVar[str] = "harmonics"
    columns: ClassVar[tuple[int, ...]] = (1, 4, 9, 16)  # of degrees 0 to 3

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.parameters.shape[1]) - 1

    @property
    def in_words(self) -> str:
        """See `Scattering.in_words`."""
        return f"{self.kind} of degree {self.degree}"

    def amplitudes(
        self, directions: Float[Tensor, "v 3"], quaternions: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "v n 1"]:
        """See `Scattering.amplitudes`; independent of orientation and shape."""
        return (self.p_min + softplus(harmonic_basis(directions, self.degree) @ self.parameters.T))[..., None]

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; degree 3, isotropic."""
        parameters = torch.zeros(count, len(CONSTANTS), dtype=torch.float32, device="cpu")
        parameters[:, 0] = softplus_inverse(gamma0 - p_min) / CONSTANTS[0]
        return cls(parameters, p_min)

    def detailed(self, degree: int) -> Self:
        """Harmonics up to that degree."""
        if degree >= self.degree:  # a full slice would be a copy
            return self
        return replace(self, parameters=self.parameters[:, : (degree + 1) ** 2])

    def joined(self, other: Scattering) -> Self:
        """See `Scattering.joined`; shorter rows are padded with zeros."""
        if not isinstance(other, Harmonics):
            return super().joined(other)
        columns = max(self.parameters.shape[1], other.parameters.shape[1])
        rows = [pad(law.parameters, (0, columns - law.parameters.shape[1])) for law in (self, other)]
        return replace(self, parameters=torch.cat(rows))


LAW = Harmonics
