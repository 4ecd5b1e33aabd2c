"""The scene model: anisotropic Gaussians that attenuate and scatter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError

MIN_SCALE = 1e-4
"""Smallest standard deviation a Gaussian may have along an axis, m."""

MAX_OPTICAL_DEPTH = 40.0
"""Largest two-way peak optical depth κ; e⁻⁴⁰ is dark, and float32 still carries it."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in physical units, every tensor differentiable, on one device and of one floating dtype.

    Parameters
    ----------
    means : Tensor [N, 3]
        Centres μ, world frame, m.
    quaternions : Tensor [N, 4]
        Orientation q = (w, x, y, z); normalised where used, must not be zero.
    scales : Tensor [N, 3]
        Standard deviations s along the Gaussian's own axes, m, at least `MIN_SCALE`.
    optical_depth : Tensor [N]
        Two-way peak optical depth κ = k⁺ + k⁻, 0 ≤ κ ≤ `MAX_OPTICAL_DEPTH`.
    harmonics : Tensor [N, K]
        Real spherical harmonics of the scattering, K = (degree + 1)², degree ≤ 3:
        P(u) = p_min + softplus(Σ_k harmonics_k Y_k(u)).
    p_min : float
        Least scattering P_min ≥ 0 (γ⁰, dimensionless). Above zero it forbids black absorbers.

    Raises
    ------
    SarsplatError
        If shapes, dtypes or devices do not fit together.
    """

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    optical_depth: Float[Tensor, " n"]
    harmonics: Float[Tensor, "n k"]
    p_min: float = 0.0

    def __post_init__(self) -> None:
        for name, tensor in self.tensors().items():
            if not isinstance(tensor, Tensor):
                raise SarsplatError(
                    f"{name} is a {type(tensor).__name__}; give a torch.Tensor (torch.as_tensor makes one)"
                )
        n = self.means.shape[0] if self.means.ndim else 0
        expected = {"means": (n, 3), "quaternions": (n, 4), "scales": (n, 3), "optical_depth": (n,)}
        for name, shape in expected.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape:
                raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}; for {n} Gaussians it must be {shape}")
        if self.harmonics.ndim != 2 or self.harmonics.shape[0] != n or self.harmonics.shape[1] not in (1, 4, 9, 16):
            raise SarsplatError(
                f"harmonics has shape {tuple(self.harmonics.shape)}; "
                f"for {n} Gaussians it must be ({n}, K) with K = 1, 4, 9 or 16 (degree 0 to 3)"
            )
        for name in (*expected, "harmonics"):
            tensor = getattr(self, name)
            if not tensor.is_floating_point() or tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise SarsplatError(
                    f"{name} is {tensor.dtype} on {tensor.device} but means is {self.means.dtype} on "
                    f"{self.means.device}; use one floating dtype and one device for all tensors"
                )
        if not 0 <= self.p_min < float("inf"):
            raise SarsplatError(f"p_min {self.p_min} must be finite and at least 0")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.harmonics.shape[1]]

    def tensors(self) -> dict[str, Tensor]:
        """The five tensors by name."""
        return {name: getattr(self, name) for name in ("means", "quaternions", "scales", "optical_depth", "harmonics")}

    def detach(self) -> Gaussians:
        """The same Gaussians outside the autograd graph."""
        return self._with(Tensor.detach)

    def to(self, target: torch.dtype | torch.device | str) -> Gaussians:
        """The same Gaussians in another dtype or on another device."""
        return self._with(lambda tensor: tensor.to(target))

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at a boolean mask [N] or at integer indices."""
        return self._with(lambda tensor: tensor[index])

    def _with(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        return Gaussians(**{name: change(tensor) for name, tensor in self.tensors().items()}, p_min=self.p_min)


def join(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both scenes in one, with the `p_min` of the first; the shorter harmonics are filled up with zeros."""
    degree = max(first.harmonics.shape[1], second.harmonics.shape[1])
    parts = [{**scene.tensors(), "harmonics": _filled(scene.harmonics, degree)} for scene in (first, second)]
    return Gaussians(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]}, p_min=first.p_min)


def _filled(harmonics: Float[Tensor, "n k"], columns: int) -> Float[Tensor, "n {columns}"]:
    return torch.nn.functional.pad(harmonics, (0, columns - harmonics.shape[1]))
