"""Anisotropic Gaussians that attenuate and scatter."""

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


def check_tensors(tensors: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]], whole: str) -> None:
    """Raise if tensors have wrong shapes (those of `whole`, for the error), or different dtypes or devices."""
    first, like = next(iter(tensors.items()))
    for name, tensor in tensors.items():
        expect(Tensor, **{name: tensor})
        if tuple(tensor.shape) != shapes[name]:
            raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}; for {whole} it must be {shapes[name]}")
        if not tensor.is_floating_point():
            raise SarsplatError(f"{name} is {tensor.dtype}; give floating-point numbers, such as torch.float32")
        if tensor.dtype != like.dtype or tensor.device != like.device:
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
        law, means = f"amplitudes of the scattering law {type(self.scattering).__name__}", self.means
        if not isinstance(result, Tensor):
            raise SarsplatError(f"{law} is of type {type(result).__name__}; return a tensor")
        v, n = len(directions), len(self)
        if result.ndim != 3 or result.shape[:2] != (v, n) or not result.shape[2]:
            raise SarsplatError(f"{law} has shape {tuple(result.shape)}; it must be ({v}, {n}, C)")
        if (result.dtype, result.device) != (means.dtype, means.device):
            raise SarsplatError(
                f"{law} is {result.dtype} on {result.device} but means is {means.dtype} on {means.device}; "
                "return its like"
            )
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
        for scene in scenes:
            if (scene.means.dtype, scene.means.device) != (scenes[0].means.dtype, scenes[0].means.device):
                raise SarsplatError(
                    f"Gaussians of {scene.means.dtype} on {scene.means.device} cannot be joined to those of "
                    f"{scenes[0].means.dtype} on {scenes[0].means.device}; convert them with .to(...)"
                )
        geometry = {name: torch.cat([getattr(scene, name) for scene in scenes]) for name in _GEOMETRY}
        laws = [scene.scattering for scene in scenes]
        return Gaussians(**geometry, scattering=reduce(lambda first, second: first.joined(second), laws))

    def _with(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        return self.with_tensors(**{name: change(tensor) for name, tensor in self.tensors().items()})


add_safe_globals([Gaussians])  # so that `torch.load` reads what `torch.save` has written
