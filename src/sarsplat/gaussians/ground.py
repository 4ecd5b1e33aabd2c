"""Ground: the plane, or the terrain, on which rays end."""

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
    """Infinite horizontal plane, or terrain, which is opaque: the rest of a ray that reaches it returns by its γ⁰.

    Every tensor is differentiable; heights are fixed.

    Parameters
    ----------
    gamma0 : Tensor [] or [ny, nx]
        γ⁰, linear: one number, or those of a square lattice around the origin, rows along y, columns along x; linear
        between places, constant beyond the last. Images sample it at their pixels' centres, so the lattice should be
        no finer than they resolve.
    pitch_m : float
        Spacing of the lattice, m.
    height_m : float or Terrain
        Height z of the plane, m, or a terrain.
    exponent : Tensor [], optional
        γ⁰ is multiplied by (sin θ) to this power, for the grazing angle θ; by default 0.

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
        tensors = {"gamma0": self.gamma0} | ({} if self.exponent is None else {"exponent": self.exponent})
        for name, tensor in tensors.items():
            if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
                kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
                raise SarsplatError(f"the ground's {name} is {kind}; give a floating-point torch.Tensor")
            if tensor.ndim not in ((0, 2) if name == "gamma0" else (0,)) or not tensor.numel():
                shapes = "one number, or a lattice [ny, nx]" if name == "gamma0" else "one number"
                raise SarsplatError(f"the ground's {name} has shape {tuple(tensor.shape)}; give {shapes}")
        for name, length, least in (("pitch_m", self.pitch_m, 0.0), ("height_m", self.span_m[0], -math.inf)):
            if not is_number(length) or not least < length < math.inf:
                allowed = "a finite" if least else "a positive, finite"
                raise SarsplatError(f"the ground's {name} is {length}; give {allowed} number of metres")

    @property
    def span_m(self) -> tuple[float, float]:
        """Lowest and highest z, m."""
        return self.height_m.span_m if isinstance(self.height_m, Terrain) else (self.height_m, self.height_m)
