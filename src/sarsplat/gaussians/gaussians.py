"""The scene model: anisotropic Gaussians that attenuate and scatter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.scattering import Scattering

MIN_SCALE = 1e-4
"""Smallest standard deviation a Gaussian may have along an axis, m."""

MAX_OPTICAL_DEPTH = 40.0
"""Largest two-way peak optical depth κ; e⁻⁴⁰ is dark, and float32 still carries it."""

_GEOMETRY = ("means", "quaternions", "scales", "optical_depth")


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in physical units, every tensor differentiable, on one device and of one floating dtype.

    `len` counts them; a slice, a boolean mask [N] or integer indices select some: `gaussians[:100]`.

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
    scattering : Scattering
        How much against direction, by a law such as `Harmonics` or `NormalLobes` with a row of parameters for each
        Gaussian.

    Raises
    ------
    SarsplatError
        If shapes, dtypes or devices do not fit together.
    """

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    optical_depth: Float[Tensor, " n"]
    scattering: Scattering

    def __post_init__(self) -> None:
        if not isinstance(self.scattering, Scattering):
            raise SarsplatError(
                f"scattering is a {type(self.scattering).__name__}; give a law with its parameters, such as "
                "Harmonics(torch.zeros(n, 16))"
            )
        for name, tensor in self.tensors().items():
            if not isinstance(tensor, Tensor):
                raise SarsplatError(
                    f"{name} is a {type(tensor).__name__}; give a torch.Tensor (torch.as_tensor makes one)"
                )
        n = self.means.shape[0] if self.means.ndim else 0
        expected = dict(zip(_GEOMETRY, ((n, 3), (n, 4), (n, 3), (n,)), strict=True))
        expected["scattering"] = (n, self.scattering.parameters.shape[1])
        for name, shape in expected.items():
            tensor = self.tensors()[name]
            if tuple(tensor.shape) != shape:
                raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}; for {n} Gaussians it must be {shape}")
            if not tensor.is_floating_point() or tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise SarsplatError(
                    f"{name} is {tensor.dtype} on {tensor.device} but means is {self.means.dtype} on "
                    f"{self.means.device}; use one floating dtype and one device for all tensors"
                )

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: int | slice | Tensor) -> Gaussians:
        if isinstance(index, int):
            if not -len(self) <= index < len(self):
                raise IndexError(f"there is no Gaussian {index} among {len(self)}")
            index = slice(index, index + 1 or None)
        return self._with(lambda tensor: tensor[index])

    def tensors(self) -> dict[str, Tensor]:
        """The five tensors by name; that of `scattering` are its parameters [N, K]."""
        return {name: getattr(self, name) for name in _GEOMETRY} | {"scattering": self.scattering.parameters}

    def with_tensors(self, **tensors: Tensor) -> Gaussians:
        """The same scene with other tensors in place of those named, as in `tensors()`."""
        merged = self.tensors() | tensors
        law = replace(self.scattering, parameters=merged.pop("scattering"))
        return Gaussians(**merged, scattering=law)

    def amplitudes(self, directions: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """What each channel returns per lit area [V, N, C] towards unit vectors u [V, 3] (`Scattering.amplitudes`)."""
        return self.scattering.amplitudes(directions, self.quaternions, self.scales)

    def gamma0(self, directions: Float[Tensor, "v 3"]) -> Float[Tensor, "v n"]:
        """γ⁰ [V, N] towards unit vectors u [V, 3] of the world frame, the power channel of it; differentiable."""
        return self.amplitudes(directions)[..., self.scattering.power_channel]

    def detach(self) -> Gaussians:
        """The same Gaussians outside the autograd graph."""
        return self._with(Tensor.detach)

    def to(self, target: torch.dtype | torch.device | str) -> Gaussians:
        """The same Gaussians in another dtype or on another device."""
        return self._with(lambda tensor: tensor.to(target))

    def _with(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        return self.with_tensors(**{name: change(tensor) for name, tensor in self.tensors().items()})


def join(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both scenes in one, under the scattering settings of the first (see `Scattering.joined`)."""
    geometry = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in _GEOMETRY}
    return Gaussians(**geometry, scattering=first.scattering.joined(second.scattering))
