"""Base class of the laws of scattering, and their registry."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid
from torch.serialization import add_safe_globals

from sarsplat.arguments import checks_arguments, described, expect
from sarsplat.errors import SarsplatError, shown
from sarsplat.names import SCATTERINGS

MIN_EXCESS = 1e-3
"""Minimum of the initial γ⁰ − p_min: softplus never reaches zero."""

L = TypeVar("L", bound="type[Scattering]")


@dataclass(frozen=True)
class Scattering(ABC):
    """Scattering law of N Gaussians: γ⁰(u), and maybe more channels, per area projected along the line of sight.

    A custom law is a frozen dataclass derived from this class, with `kind` and `amplitudes`; trainings also need
    `initial`. `register_scattering` makes it known to trainings and files. Settings that are not learned are further
    fields, of types that JSON can represent.

    Parameters
    ----------
    parameters : Tensor [N, K]
        Learned parameters, a row for each Gaussian. The first column is the isotropic part, the others differences
        between directions, with a separate learning rate. A training with more than 16 columns is slower.
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
    """Name in files and configurations."""

    columns: ClassVar[tuple[int, ...]] = ()
    """Allowed numbers of columns of the parameters; any if empty."""

    channels: ClassVar[tuple[str, ...]] = ("power",)
    """Names of the images' C channels."""

    power_channel: ClassVar[int] = 0
    """Index of the channel with γ⁰, the power that is shown, scored and trained on."""

    oriented: ClassVar[bool] = False
    """True if γ⁰ depends on the choice of a Gaussian's shortest axis."""

    common: ClassVar[tuple[tuple[float, float], ...]] = ()
    """Ranges of the last columns of the parameters, which all Gaussians of a training may share."""

    def __init_subclass__(cls) -> None:
        add_safe_globals([cls])  # so that `torch.load` reads Gaussians that `torch.save` has written

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.__post_init__()  # files may be invalid

    def __post_init__(self) -> None:
        expect(Tensor, parameters=self.parameters)
        expect(float, p_min=self.p_min)
        if not 0 <= self.p_min < math.inf:
            raise SarsplatError(f"p_min {self.p_min} must be finite and at least 0")
        shape, allowed = tuple(self.parameters.shape), self.columns
        if len(shape) != 2 or (shape[1] not in allowed if allowed else shape[1] < 1):
            numbers = " or ".join(", ".join(map(str, allowed)).rsplit(", ", 1))
            condition = f"= {numbers}" if allowed else "at least 1"
            raise SarsplatError(f"scattering has shape {shape}; for N Gaussians it must be (N, K) with K {condition}")

    @abstractmethod
    def amplitudes(
        self, directions: Float[Tensor, "v 3"], quaternions: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "v n c"]:
        """Amplitudes of each channel per lit area [V, N, C] towards unit vectors u [V, 3] of the world frame.

        Dimensionless and differentiable. Channel `power_channel` is γ⁰ ≥ 0; others may have any sign.
        """

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        """Initial law of a training, equal for all Gaussians, with mean `gamma0` over all directions; float32, CPU.

        Raises
        ------
        SarsplatError
            If the law does not implement it and so can be rendered, but not trained.
        """
        raise SarsplatError(
            f"a training cannot start with the scattering law {cls.__name__}; give it a class method "
            "initial(count, gamma0, p_min)"
        )

    @property
    def in_words(self) -> str:
        """Description in `sarsplat info` and reports; by default the kind."""
        return self.kind

    def detailed(self, degree: int) -> Self:
        """Law limited to the detail `degree`, 0 to 3, which a training increases; by default unlimited."""
        return self

    def times(self, factor: float) -> Self:
        """Law with `factor` times the γ⁰; itself, the default, if that is no law of its kind."""
        return self

    def for_polarisations(self, polarisations: tuple[str, ...]) -> Self:
        """Initial law for images in two or more polarisations; by default unchanged."""
        return self

    def settings(self) -> dict[str, Any]:
        """Settings that are not learned, by name; with `kind` and the parameters, they define the law."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "parameters"}

    @checks_arguments
    def joined(self, other: Scattering) -> Self:
        """Concatenate both parameter tables, under the settings of the first."""
        if type(other) is not type(self):
            raise SarsplatError(
                f"{self.kind} and {other.kind} cannot be joined; give both scenes one kind of scattering"
            )
        return replace(self, parameters=torch.cat([self.parameters, other.parameters]))


def register_scattering(law: L) -> L:
    """Register a law under its `kind`, as a decorator: for the setting `scattering` and for files.

    This holds for the running program. A package registers a law for all programs, including the command line, by an
    entry point of the group `sarsplat.scattering`, whose name is the kind.

    Raises
    ------
    SarsplatError
        If it is not a law with a kind, or another law has that kind.
    """
    if not (isinstance(law, type) and issubclass(law, Scattering) and isinstance(getattr(law, "kind", None), str)):
        raise SarsplatError(f"law is {described(law)}; give a class derived from Scattering with a kind, a str")
    other = SCATTERINGS.get(law.kind)
    if other is not None and _home(other) != _home(law):
        raise SarsplatError(f"the scattering law {law.kind!r} is {_home(other)} already; give yours another kind")
    SCATTERINGS.add(law.kind, law)
    return law


def _home(law: type[Scattering]) -> str:
    return f"{law.__module__}.{law.__qualname__}"


@checks_arguments
def scattering_named(kind: str) -> type[Scattering]:
    """Law of a kind.

    Raises
    ------
    SarsplatError
        If the kind is unknown, or its package is faulty.
    """
    if kind not in SCATTERINGS:
        raise SarsplatError(
            f"the scattering law {shown(kind)} is unknown; choose one of {', '.join(SCATTERINGS)}, or register yours "
            "(sarsplat.gaussians.register_scattering)"
        )
    law = SCATTERINGS[kind]
    if getattr(law, "kind", None) != kind:
        raise SarsplatError(
            f"the entry point {kind!r} of sarsplat.scattering names {law!r}, which is not a law of that kind; correct "
            "its package"
        )
    return law


def softplus(values: Tensor) -> Tensor:
    """Softplus log(1 + e^x); unlike torch's, its bits do not depend on the number of threads."""
    return -logsigmoid(-values)


def softplus_inverse(value: float) -> float:
    """Inverse of softplus, for values of at least `MIN_EXCESS`."""
    value = max(value, MIN_EXCESS)
    return value + math.log(-math.expm1(-value))  # the exponential of large values would overflow
