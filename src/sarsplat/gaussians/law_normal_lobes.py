"""γ⁰ in a lobe around the surface normal."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import one_hot

from sarsplat.gaussians.gaussians import rotated
from sarsplat.gaussians.scattering import MIN_EXCESS, Scattering, softplus, softplus_inverse

_IN_LOBE = 0.2
"""Initial share of γ⁰ in the lobe. Larger ones rotate Gaussians before their law is known, which is worse for isotropic
or varied surfaces; smaller ones are worse for surfaces that follow a cosine."""

_GRAZING = 1e-12  # minimum squared cosine, for a finite logarithm
_MOST_LOG = 5.0  # maximum absolute logarithm of an exponent


@dataclass(frozen=True)
class NormalLobes(Scattering):
    """Lobe around the surface normal: γ⁰(u) = p_min + b₀ + b₁·|n·u|ᵉ.

    n is the shortest axis of a Gaussian, and two-sided: a flat Gaussian is a piece of surface. e = 1 is Lambert's law,
    larger exponents are narrower. Differentiable with respect to quaternions, too; the choice of the shortest axis is
    held constant.

    Parameters
    ----------
    parameters : Tensor [N, 3]
        softplus of the first two is b₀, which is isotropic, and b₁; the third is the logarithm of e, which all
        Gaussians of a training may share.
    p_min : float
        Minimum scattering P_min ≥ 0 (γ⁰).
    """

    kind: ClassVar[str] = "normal-lobes"
    columns: ClassVar[tuple[int, ...]] = (3,)  # b₀, b₁ and e
    oriented: ClassVar[bool] = True
    common: ClassVar[tuple[tuple[float, float], ...]] = ((0.0, math.log(32)),)

    @property
    def in_words(self) -> str:
        """See `Scattering.in_words`; with the smallest and the largest exponent, if they differ."""
        exponents = torch.aminmax(self._exponents) if len(self.parameters) else ()
        shown = dict.fromkeys(f"{float(e):.2f}" for e in exponents)
        return f"{self.kind}, γ⁰ = {self.p_min:g} + b₀ + b₁·|n·u|ᵉ" + (f", e = {' … '.join(shown)}" if shown else "")

    def amplitudes(
        self, directions: Float[Tensor, "v 3"], quaternions: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "v n 1"]:
        """See `Scattering.amplitudes`."""
        shortest = one_hot(scales.detach().argmin(dim=1), 3)
        normals = rotated(quaternions, shortest.to(quaternions))
        squared = ((directions @ normals.T) ** 2).clamp(min=_GRAZING)  # [V, N]
        b = softplus(self.parameters[:, :2])
        return (self.p_min + b[:, 0] + b[:, 1] * squared ** (self._exponents / 2))[..., None]

    def times(self, factor: float) -> Self:
        """See `Scattering.times`; exact to rounding."""
        b = (factor * softplus(self.parameters[:, :2].double())).clamp(min=torch.finfo(torch.float64).tiny)
        inverse = (b + torch.log(-torch.expm1(-b))).to(self.parameters)
        return replace(self, parameters=torch.cat([inverse, self.parameters[:, 2:]], dim=1), p_min=factor * self.p_min)

    @property
    def _exponents(self) -> Float[Tensor, " n"]:
        """Exponent of each Gaussian."""
        return self.parameters[:, 2].clamp(-_MOST_LOG, _MOST_LOG).exp()

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; a share of it is in a lobe of a squared cosine."""
        excess = max(gamma0 - p_min, MIN_EXCESS)
        b = ((1 - _IN_LOBE) * excess, 3 * _IN_LOBE * excess)  # cos² is 1/3 on average
        row = torch.tensor([*(softplus_inverse(value) for value in b), math.log(2)], dtype=torch.float32, device="cpu")
        return cls(row.repeat(count, 1), p_min)


LAW = NormalLobes
