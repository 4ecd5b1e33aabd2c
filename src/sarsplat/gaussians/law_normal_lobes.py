"""γ⁰ in lobes around the surface normal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import one_hot

from sarsplat.arguments import expect
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.covariance import rotated
from sarsplat.gaussians.scattering import MIN_EXCESS, Scattering, softplus, softplus_inverse

_IN_LOBE = 0.2
"""Share of γ⁰ that a lobe starts with. With half of it, surfaces that scatter the same to all sides, or have parts that
differ, come out worse, because Gaussians turn before their law is known; with little, those that follow a cosine do."""


@dataclass(frozen=True)
class NormalLobes(Scattering):
    """Lobes around the surface normal: γ⁰(u) = p_min + b₀ + Σ_j b_j·exp(κ_j((n·u)² − 1)).

    n is the shortest axis of a Gaussian, and two-sided: a flat Gaussian is a piece of surface. Differentiable with
    respect to quaternions too; which axis is the shortest is held constant.

    Parameters
    ----------
    parameters : Tensor [N, 1 + J]
        softplus of them is b₀, the same in all directions, and b_1 … b_J.
    p_min : float
        Minimum scattering P_min ≥ 0 (γ⁰).
    sharpness : tuple of J numbers
        κ_j ≥ 0, fixed. Zero would only repeat b₀, so it stands for the squared cosine (n·u)².
    """

    sharpness: tuple[float, ...] = (0.0,)

    kind: ClassVar[str] = "normal-lobes"
    oriented: ClassVar[bool] = True

    def __post_init__(self) -> None:
        expect(tuple[float, ...], sharpness=self.sharpness)
        object.__setattr__(self, "sharpness", tuple(self.sharpness))  # JSON has lists
        if not all(0 <= value < math.inf for value in self.sharpness):
            raise SarsplatError(f"sharpness {self.sharpness} of the lobes must be finite and at least 0")
        super().__post_init__()

    @property
    def columns(self) -> tuple[int, ...]:
        """One for all directions, and one for each lobe."""
        return (1 + len(self.sharpness),)

    def amplitudes(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n 1"]:
        """See `Scattering.amplitudes`."""
        shortest = one_hot(scales.detach().argmin(dim=1), 3)
        normals = rotated(quaternions, shortest.to(quaternions))
        squared = (directions @ normals.T) ** 2  # [V, N]
        b = softplus(self.parameters)
        total = self.p_min + b[:, 0].expand(len(directions), -1)
        for j, sharpness in enumerate(self.sharpness, start=1):
            total = total + b[:, j] * (squared if sharpness == 0 else torch.exp(sharpness * (squared - 1)))
        return total[..., None]

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; a part of it in one lobe, the squared cosine."""
        excess = max(gamma0 - p_min, MIN_EXCESS)
        b = ((1 - _IN_LOBE) * excess, 3 * _IN_LOBE * excess)  # cos² is 1/3 on average
        raw = torch.tensor([softplus_inverse(value) for value in b], device="cpu")
        return cls(raw.repeat(count, 1), p_min)


LAW = NormalLobes
