"""Covariances between polarisations: γ⁰ in spherical harmonics, and a matrix for each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar, Self

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from sarsplat.arguments import expect
from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians.law_harmonics import CONSTANTS, Harmonics
from sarsplat.gaussians.scattering import Scattering, softplus, softplus_inverse
from sarsplat.geometry.stack import POLARISATIONS

_LINEAR = ("HH", "HV", "VV")
_MOST = 4


@dataclass(frozen=True)
class Polarimetric(Scattering):
    """Covariances of P polarisations: E[y yᴴ] = γ⁰(u)·V, with one V for all directions.

    V is Hermitian and positive semi-definite, and the mean of its diagonal is 1, so that γ⁰ is the mean power. With a
    lower triangular L, V = P·L Lᴴ / tr L Lᴴ.

    Channels of images are γ⁰, the powers of the P polarisations, and for all pairs i < j the real parts of E[y_i y_j*],
    then the imaginary parts (`covariances_between`).

    Parameters
    ----------
    parameters : Tensor [N, P² + K]
        Column 0 is a_0 and the last K − 1 are the other coefficients of γ⁰ = p_min + softplus(Σ_k a_k Y_k(u)) in K = 1,
        4, 9 or 16 harmonics. Between them are the P² numbers of L: softplus of the first P is its diagonal, then come
        the real and the imaginary parts below the diagonal, row by row.
    p_min : float
        Minimum scattering P_min ≥ 0 (γ⁰).
    polarisations : tuple of str
        Received and transmitted polarisation, such as "HV"; 2 to 4 pairs.
    """

    polarisations: tuple[str, ...] = _LINEAR

    kind: ClassVar[str] = "polarimetric"

    def __post_init__(self) -> None:
        expect(tuple[str, ...], polarisations=self.polarisations)
        object.__setattr__(self, "polarisations", tuple(self.polarisations))  # JSON has lists
        names = self.polarisations
        if not 2 <= len(names) <= _MOST or len(set(names)) < len(names) or not set(names) <= set(POLARISATIONS):
            raise SarsplatError(
                f"polarisations is {shown(names)}; give 2 to {_MOST} different ones of {', '.join(POLARISATIONS)}"
            )
        super().__post_init__()

    @property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]  # as many as there are polarisations
        """Names of the channels: γ⁰, powers, and real and imaginary parts of the pairs."""
        pairs = [f"{one} {other}*" for one, other in combinations(self.polarisations, 2)]
        return ("power", *self.polarisations, *(f"Re {pair}" for pair in pairs), *(f"Im {pair}" for pair in pairs))

    @property
    def columns(self) -> tuple[int, ...]:  # type: ignore[override]
        """Numbers of columns for degrees 0 to 3."""
        return tuple(self._shape + harmonics for harmonics in Harmonics.columns)

    def amplitudes(
        self, directions: Float[Tensor, "v 3"], quaternions: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "v n c"]:
        """See `Scattering.amplitudes`; independent of orientation and shape."""
        coefficients = torch.cat([self.parameters[:, :1], self.parameters[:, 1 + self._shape :]], dim=1)
        return Harmonics(coefficients, self.p_min).amplitudes(directions, quaternions, scales) * self._packed()

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; degree 3, isotropic, with uncorrelated polarisations of equal power."""
        return cls(_start(count, gamma0 - p_min, len(_LINEAR)), p_min)

    def detailed(self, degree: int) -> Self:
        """Law with harmonics up to that degree."""
        columns = self._shape + (degree + 1) ** 2
        if columns >= self.parameters.shape[1]:
            return self
        return replace(self, parameters=self.parameters[:, :columns])

    def for_polarisations(self, polarisations: tuple[str, ...]) -> Self:
        """See `Scattering.for_polarisations`; uncorrelated polarisations of equal power, and isotropic γ⁰."""
        if polarisations == self.polarisations:
            return self
        start = _start(len(self.parameters), 1.0, len(polarisations))
        start[:, 0] = self.parameters[:, 0]
        return replace(self, parameters=start, polarisations=polarisations)

    @property
    def _shape(self) -> int:
        return len(self.polarisations) ** 2

    def _packed(self) -> Float[Tensor, "n c"]:
        """Columns 1 and the entries of V, in real arithmetic, so that bits do not depend on the number of threads."""
        count = len(self.polarisations)
        pairs = count * (count - 1) // 2
        raw = self.parameters[:, 1 : 1 + self._shape]
        diagonal = softplus(raw[:, :count]).unbind(1)
        real, imaginary = raw[:, count : count + pairs], raw[:, count + pairs :]
        below = {(i, k): n for n, (i, k) in enumerate((i, k) for i in range(count) for k in range(i))}

        def entry(i: int, k: int) -> tuple[Tensor, Tensor]:
            if i == k:
                return diagonal[i], torch.zeros_like(diagonal[i])
            return real[:, below[i, k]], imaginary[:, below[i, k]]

        def product(i: int, j: int) -> tuple[Tensor, Tensor]:
            """Entry (L Lᴴ)_ij for i ≤ j."""
            re, im = torch.zeros_like(diagonal[0]), torch.zeros_like(diagonal[0])
            for k in range(i + 1):
                (a, b), (c, d) = entry(i, k), entry(j, k)
                re, im = re + a * c + b * d, im + b * c - a * d
            return re, im

        powers = [product(i, i)[0] for i in range(count)]
        between = [product(i, j) for i, j in combinations(range(count), 2)]
        total = torch.stack([*powers, *(re for re, _ in between), *(im for _, im in between)], dim=1)
        mean = sum(powers[1:], powers[0]) / count
        return torch.cat([torch.ones_like(total[:, :1]), total / mean[:, None]], dim=1)


def covariances_between(
    amplitudes: Float[Tensor, "*shape c"], polarisations: int
) -> Complex[Tensor, "*shape {polarisations} {polarisations}"]:
    """Hermitian matrices E[y_i y_j*] from the channels of `Polarimetric`, which are the last dimension."""
    powers, pairs = amplitudes[..., 1 : 1 + polarisations], amplitudes[..., 1 + polarisations :]
    real, imaginary = pairs.chunk(2, dim=-1)
    matrices = torch.diag_embed(powers).to(powers.dtype.to_complex())
    first, second = torch.triu_indices(polarisations, polarisations, 1)
    matrices[..., first, second] = between = torch.complex(real.contiguous(), imaginary.contiguous())
    matrices[..., second, first] = between.conj()
    return matrices


def _start(count: int, excess: float, polarisations: int) -> Float[Tensor, "{count} k"]:
    parameters = torch.zeros(count, polarisations**2 + len(CONSTANTS), dtype=torch.float32, device="cpu")
    parameters[:, 0] = softplus_inverse(excess) / CONSTANTS[0]
    parameters[:, 1 : 1 + polarisations] = softplus_inverse(1.0)
    return parameters


LAW = Polarimetric
