"""How strongly Gaussians scatter towards the radar: laws of it against direction, each with its table of parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.gaussians.harmonics import CONSTANTS, harmonic_basis

_MIN_EXCESS = 1e-3
"""γ⁰ above p_min that a law starts with at least: softplus never reaches zero."""

_IN_LOBE = 0.2
"""Share of γ⁰ that a lobe starts with. With half of it, surfaces that scatter alike to all sides, or have parts that
differ, come out worse, because Gaussians turn before their law is known; with little, those that follow a cosine do."""


@dataclass(frozen=True)
class Scattering(ABC):
    """What N Gaussians scatter towards u per area projected along the line of sight, dimensionless; first of all γ⁰(u).

    To add a law, derive from this class, name its `kind`, and list it in `SCATTERING_LAWS` (sarsplat/names.py), where
    everything else finds it. Settings of a law that are not learned are further fields, of types that JSON can hold.

    Parameters
    ----------
    parameters : Tensor [N, K]
        What is learned, a row for each Gaussian. The first column speaks for all directions, the others of differences
        between them: they have learning rates of their own. A training with more than 16 columns is slower.
    p_min : float
        Minimum scattering P_min ≥ 0 (γ⁰). Above zero it forbids black absorbers.

    Raises
    ------
    SarsplatError
        If a shape or `p_min` does not fit.
    """

    parameters: Float[Tensor, "n k"]
    p_min: float = 0.0

    kind: ClassVar[str]
    """Its name in files and configurations."""

    channels: ClassVar[tuple[str, ...]] = ("power",)
    """What the channels of its images are, C of them."""

    power_channel: ClassVar[int] = 0
    """Which of them is γ⁰, the power: what is shown, scored and trained on."""

    oriented: ClassVar[bool] = False
    """Whether γ⁰ depends on which axis of a Gaussian is the shortest."""

    def __post_init__(self) -> None:
        if not isinstance(self.parameters, Tensor):
            raise SarsplatError(
                f"the parameters of the scattering are a {type(self.parameters).__name__}; give a torch.Tensor "
                "(torch.as_tensor makes one)"
            )
        if not 0 <= self.p_min < math.inf:
            raise SarsplatError(f"p_min {self.p_min} must be finite and at least 0")
        if (wrong := self._shape_error()) is not None:
            raise SarsplatError(f"scattering has shape {tuple(self.parameters.shape)}; {wrong}")

    @abstractmethod
    def _shape_error(self) -> str | None:
        """What the parameters' shape must be, if it is another."""

    @abstractmethod
    def amplitudes(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n c"]:
        """What each channel returns per lit area [V, N, C], of Gaussians turned and shaped like this; differentiable.

        Towards unit vectors u [V, 3] of the world frame; dimensionless. `power_channel` of them is γ⁰, which is never
        negative; the others may have any sign.
        """

    @classmethod
    @abstractmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """Where a training starts: alike for all Gaussians, γ⁰ on average over all directions; float32, on the CPU."""

    def detailed(self, degree: int) -> Self:
        """The law with no more detail than `degree`, 0 to 3: a training adds it by and by; most laws have none."""
        return self

    def settings(self) -> dict[str, Any]:
        """What is not learned, by name; with `kind` and the parameters it makes the same law again."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "parameters"}

    def joined(self, other: Scattering) -> Self:
        """Both tables, one below the other, under the settings of the first."""
        if type(other) is not type(self):
            raise SarsplatError(
                f"{self.kind} and {other.kind} cannot be joined; give both scenes one kind of scattering"
            )
        return replace(self, parameters=torch.cat([self.parameters, other.parameters]))


@dataclass(frozen=True)
class Harmonics(Scattering):
    """Real spherical harmonics: γ⁰(u) = p_min + softplus(Σ_k parameters_k Y_k(u)).

    `parameters` is [N, K] with K = (degree + 1)², degree ≤ 3; order and signs are those of 3D Gaussian splatting
    (docs/conventions.md). Whatever else is at `Scattering` holds here too.
    """

    kind: ClassVar[str] = "harmonics"

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.parameters.shape[1]) - 1

    def _shape_error(self) -> str | None:
        if self.parameters.ndim == 2 and self.parameters.shape[1] in (1, 4, 9, 16):
            return None
        return "for N Gaussians it must be (N, K) with K = 1, 4, 9 or 16 (harmonics of degree 0 to 3)"

    def amplitudes(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n 1"]:
        """See `Scattering.amplitudes`; how a Gaussian is turned does not matter."""
        return (self.p_min + _softplus(harmonic_basis(directions, self.degree) @ self.parameters.T))[..., None]

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; of degree 3, and the same in all directions."""
        parameters = torch.zeros(count, len(CONSTANTS), device="cpu")
        parameters[:, 0] = _softplus_inverse(gamma0 - p_min) / CONSTANTS[0]
        return cls(parameters, p_min)

    def detailed(self, degree: int) -> Self:
        """The harmonics up to that degree."""
        if degree >= self.degree:  # a slice of everything would be a copy all the same
            return self
        return replace(self, parameters=self.parameters[:, : (degree + 1) ** 2])

    def joined(self, other: Scattering) -> Self:
        """See `Scattering.joined`; the shorter rows are filled up with zeros."""
        if not isinstance(other, Harmonics):
            return super().joined(other)
        columns = max(self.parameters.shape[1], other.parameters.shape[1])
        rows = [pad(law.parameters, (0, columns - law.parameters.shape[1])) for law in (self, other)]
        return replace(self, parameters=torch.cat(rows))


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
        object.__setattr__(self, "sharpness", tuple(self.sharpness))  # JSON has lists
        if not all(0 <= value < math.inf for value in self.sharpness):
            raise SarsplatError(f"sharpness {self.sharpness} of the lobes must be finite and at least 0")
        super().__post_init__()

    def _shape_error(self) -> str | None:
        wanted = 1 + len(self.sharpness)
        if self.parameters.ndim == 2 and self.parameters.shape[1] == wanted:
            return None
        return f"for N Gaussians and {len(self.sharpness)} lobes it must be (N, {wanted})"

    def amplitudes(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n 1"]:
        """See `Scattering.amplitudes`."""
        axes, shortest = rotation_matrix(quaternions), scales.detach().argmin(dim=1)
        normals = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
        squared = (directions @ normals.T) ** 2  # [V, N]
        b = _softplus(self.parameters)
        total = self.p_min + b[:, 0].expand(len(directions), -1)
        for j, sharpness in enumerate(self.sharpness, start=1):
            total = total + b[:, j] * (squared if sharpness == 0 else torch.exp(sharpness * (squared - 1)))
        return total[..., None]

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """See `Scattering.initial`; a part of it in one lobe, the squared cosine."""
        excess = max(gamma0 - p_min, _MIN_EXCESS)
        b = ((1 - _IN_LOBE) * excess, 3 * _IN_LOBE * excess)  # cos² is 1/3 on average
        raw = torch.tensor([_softplus_inverse(value) for value in b], device="cpu")
        return cls(raw.repeat(count, 1), p_min)


def _softplus(values: Tensor) -> Tensor:
    """log(1 + e^x). torch rounds the last numbers of a thread's share otherwise: bits would depend on threads."""
    return -logsigmoid(-values)


def _softplus_inverse(value: float) -> float:
    value = max(value, _MIN_EXCESS)
    return value + math.log(-math.expm1(-value))  # of large ones the exponential would overflow
