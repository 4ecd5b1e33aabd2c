"""The ground: the plane, or the terrain, on which rays end."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import is_number
from sarsplat.errors import SarsplatError
from sarsplat.geometry import Terrain


@dataclass(frozen=True)
class Ground:
    """A horizontal plane, or terrain: what is left of a ray that reaches it returns by the ground's γ⁰ there.

    Nothing below or behind it is seen, and it has no end. Every tensor is differentiable; heights are fixed.

    Parameters
    ----------
    gamma0 : Tensor [] or [ny, nx]
        γ⁰, linear: one number, or those of places on a square lattice around the origin, rows along y, columns along x;
        linear between them, and beyond the last ones as there. Images show it at their pixels' centres, so places
        should lie no closer than the images resolve.
    pitch_m : float
        Distance of the places, m.
    height_m : float or Terrain
        Height z of the plane, m, or heights of places.
    exponent : Tensor [], optional
        Law of the grazing angle θ: γ⁰ is the above times (sin θ) to this power; 0 unless given, the same at all angles.

    Raises
    ------
    SarsplatError
        If a tensor has another shape, or no floating dtype, or a length is not finite.
    """

    gamma0: Tensor
    pitch_m: float = 1.0
    height_m: float | Terrain = 0.0
    exponent: Float[Tensor, ""] | None = None

    def __post_init__(self) -> None:
        for name, tensor, dimensions in (("gamma0", self.gamma0, (0, 2)), ("exponent", self.exponent, (0,))):
            if tensor is None and name == "exponent":
                continue
            if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
                kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
                raise SarsplatError(f"the ground's {name} is {kind}; give a floating-point torch.Tensor")
            if tensor.ndim not in dimensions or not tensor.numel():
                wanted = "one number" + (", or a lattice [ny, nx]" if 2 in dimensions else "")
                raise SarsplatError(f"the ground's {name} has shape {tuple(tensor.shape)}; give {wanted}")
        for name, length, positive in (("pitch_m", self.pitch_m, True), ("height_m", self.span_m[0], False)):
            if not is_number(length) or not math.isfinite(length) or (positive and length <= 0):
                what = "a positive, finite" if positive else "a finite"
                raise SarsplatError(f"the ground's {name} is {length}; give {what} number of metres")

    @property
    def span_m(self) -> tuple[float, float]:
        """Lowest and highest z, m."""
        return self.height_m.span_m if isinstance(self.height_m, Terrain) else (self.height_m, self.height_m)
