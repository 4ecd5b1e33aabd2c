"""Anisotropic Gaussians that attenuate and scatter, and their rotations (docs/concepts/image-model.md §2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.serialization import add_safe_globals

from sarsplat.arguments import checks_arguments, described, expect
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians.scattering import Scattering

MIN_SCALE = 1e-4
"""Minimum standard deviation along an axis, m."""

MAX_OPTICAL_DEPTH = 40.0
"""Maximum two-way peak optical depth κ; float32 still resolves e⁻⁴⁰."""

_INDEX = "give an integer, a slice, a mask [N] or integers [M]"
_GEOMETRY = ("means", "quaternions", "scales", "optical_depth")


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


def check_tensors(tensors: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]], whole: str) -> None:
    """Raise if tensors have wrong shapes (those of `whole`, for the error), or different dtypes or devices."""
    for name, tensor in tensors.items():
        expect(Tensor, **{name: tensor})
        if tuple(tensor.shape) != shapes[name]:
            raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}; for {whole} it must be {shapes[name]}")
        if not tensor.is_floating_point():
            raise SarsplatError(f"{name} is {tensor.dtype}; give floating-point numbers, such as torch.float32")
    check_same_kind(tensors)


def check_same_kind(tensors: Mapping[str, Tensor | None]) -> None:
    """Raise if a tensor, unless None, has another dtype or device than the first."""
    (first, like), *others = ((name, tensor) for name, tensor in tensors.items() if tensor is not None)
    for name, tensor in others:
        if (tensor.dtype, tensor.device) != (like.dtype, like.device):
            raise SarsplatError(
                f"{name} is {tensor.dtype} on {tensor.device} but {first} is {like.dtype} on {like.device}; use one "
                "floating dtype and one device for all tensors"
            )


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in physical units, as differentiable tensors on one device and of one floating dtype.

    `len` is N. An integer, a slice, a boolean mask [N] or integer indices select Gaussians (`gaussians[:100]`),
    `Gaussians.cat` joins scenes, and `to` converts; gradients flow through all three.

    Parameters
    ----------
    means : Tensor [N, 3]
        Centres μ, world frame, m.
    quaternions : Tensor [N, 4]
        Orientation q = (w, x, y, z); normalised where used, must not be zero.
    scales : Tensor [N, 3]
        Standard deviations s along the Gaussian's axes, m, at least `MIN_SCALE`.
    optical_depth : Tensor [N]
        Two-way peak optical depth κ = k⁺ + k⁻, 0 ≤ κ ≤ `MAX_OPTICAL_DEPTH`.
    scattering : Scattering
        Scattering law by direction, such as `Harmonics` or `NormalLobes`, with a row of parameters per Gaussian.

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
        expect(Scattering, scattering=self.scattering)
        n = len(self.means) if isinstance(self.means, Tensor) and self.means.ndim else 0
        shapes: dict[str, tuple[int, ...]] = {"means": (n, 3), "quaternions": (n, 4), "scales": (n, 3)}
        shapes |= {"optical_depth": (n,), "scattering": (n, self.scattering.parameters.shape[1])}
        check_tensors(self.tensors(), shapes, f"{n} Gaussians")

    def __repr__(self) -> str:
        law, means = self.scattering, self.means
        scattering = f"{law.kind} with {counted(law.parameters.shape[1], 'number')}"
        return f"Gaussians({len(self):,}, {scattering}, {means.dtype}, {means.device})"

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.__post_init__()  # files may be invalid

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Any) -> Gaussians:
        try:
            chosen = torch.arange(len(self), device=self.means.device)[index]
        except TypeError as error:
            raise SarsplatError(f"the index is {described(index)}; {_INDEX}") from error
        if chosen.ndim > 1:
            raise IndexError(f"Gaussians have one index; {_INDEX}")
        return self._with(lambda tensor: tensor[index if chosen.ndim else chosen[None]])

    def tensors(self) -> dict[str, Tensor]:
        """All five tensors by name; "scattering" has the law's parameters [N, K]."""
        return {name: getattr(self, name) for name in _GEOMETRY} | {"scattering": self.scattering.parameters}

    def with_tensors(self, **tensors: Tensor) -> Gaussians:
        """Copy with some tensors replaced, by their names in `tensors()`."""
        merged = self.tensors() | tensors
        law = replace(self.scattering, parameters=merged.pop("scattering"))
        return Gaussians(**merged, scattering=law)

    @checks_arguments
    def amplitudes(self, directions: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """Amplitudes of each channel per lit area [V, N, C] towards unit vectors u [V, 3] (`Scattering.amplitudes`).

        Raises
        ------
        SarsplatError
            If the law returns another shape, dtype or device, which engines would misread.
        """
        result = self.scattering.amplitudes(directions, self.quaternions, self.scales)
        law = f"amplitudes of the scattering law {type(self.scattering).__name__}"
        if not isinstance(result, Tensor):
            raise SarsplatError(f"{law} is of type {type(result).__name__}; return a tensor")
        v, n = len(directions), len(self)
        if result.ndim != 3 or result.shape[:2] != (v, n) or not result.shape[2]:
            raise SarsplatError(f"{law} has shape {tuple(result.shape)}; it must be ({v}, {n}, C)")
        check_same_kind({"means": self.means, law: result})
        return result

    @checks_arguments
    def gamma0(self, directions: Float[Tensor, "v 3"]) -> Float[Tensor, "v n"]:
        """γ⁰ [V, N], the power channel, towards unit vectors u [V, 3] of the world frame; differentiable."""
        return self.amplitudes(directions)[..., self.scattering.power_channel]

    def detach(self) -> Gaussians:
        """Copy outside of the autograd graph."""
        return self._with(Tensor.detach)

    def to(self, *target: Any, **options: Any) -> Gaussians:
        """Copy on another device or in another dtype; arguments are those of `torch.Tensor.to`."""
        try:
            return self._with(lambda tensor: tensor.to(*target, **options))
        except (RuntimeError, AssertionError, TypeError) as error:  # torch's, for missing devices and wrong arguments
            values = ", ".join(shown(value) for value in (*target, *options.values()))
            reason = str(error).partition("\n")[0]
            raise SarsplatError(
                f"Gaussians cannot be turned to {values} ({reason}); give a device that is there, or a dtype"
            ) from error

    @staticmethod
    @checks_arguments
    def cat(scenes: Sequence[Gaussians]) -> Gaussians:
        """Concatenate scenes, under the scattering settings of the first (see `Scattering.joined`).

        Raises
        ------
        SarsplatError
            If there is no scene, or their scattering laws, dtypes or devices differ.
        """
        if not scenes:
            raise SarsplatError("there are no Gaussians to join; give at least one scene")
        check_same_kind({f"scene {k}": scene.means for k, scene in enumerate(scenes)})
        geometry = {name: torch.cat([getattr(scene, name) for scene in scenes]) for name in _GEOMETRY}
        laws = [scene.scattering for scene in scenes]
        return Gaussians(**geometry, scattering=reduce(lambda first, second: first.joined(second), laws))

    def _with(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        return self.with_tensors(**{name: change(tensor) for name, tensor in self.tensors().items()})


add_safe_globals([Gaussians])  # so that `torch.load` reads what `torch.save` has written
