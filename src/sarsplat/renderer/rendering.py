"""Results of a rendering."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError


@dataclass(frozen=True)
class RayMap:
    """Transmittance and first returns of one view's rays, on its ray lattice (rows: y_r, columns: x_r).

    Parameters
    ----------
    transmittance : Tensor [rows, columns]
        Two-way transmittance T_end behind all Gaussians; differentiable.
    first_return : Tensor [rows, columns]
        Slant range z_r, m, at which the two-way optical depth reaches the requested value, else NaN; not
        differentiable.
    origin : (float, float)
        (x_r, y_r) of the ray in row 0, column 0, m.
    """

    transmittance: Float[Tensor, "rows columns"]
    first_return: Float[Tensor, "rows columns"]
    origin: tuple[float, float]


@dataclass(frozen=True)
class Rendering:
    """Images of V views, and the contribution of each Gaussian.

    Parameters
    ----------
    images : Tensor [V, C, rows, columns]
        One for each channel of the scattering, differentiable; β⁰, linear power, of the channel that is power.
    cross_sections : Tensor [V, N, C]
        Radar cross-section σ of each Gaussian in each channel, m²; differentiable.
    lit_area : Tensor [V, N]
        A_c Σ_ρ w, m²: visible area of a Gaussian across the line of sight. Not differentiable.
    ray_maps : tuple of RayMap, one per view, or None
        On request (`first_return_depth`).
    plane_gradients : Tensor [V, N, 4] or None
        On request: zeros until backward, then ∂L/∂(μ_C,x, μ_C,y, μ_I,x, μ_I,z) per view, per m. For density control.
    echoes : tuple of Tensor [V, rows, columns]
        Part of the images from each echo, the ground first, β⁰, linear power, without gain; differentiable.
    ground : Tensor [V, rows, columns] or None
        The first of these, if a ground was given.
    """

    images: Float[Tensor, "v c rows columns"]
    cross_sections: Float[Tensor, "v n c"]
    lit_area: Float[Tensor, "v n"]
    ray_maps: tuple[RayMap, ...] | None = None
    plane_gradients: Float[Tensor, "v n 4"] | None = None
    echoes: tuple[Float[Tensor, "v rows columns"], ...] = ()
    ground: Float[Tensor, "v rows columns"] | None = None

    def __repr__(self) -> str:
        """Shapes instead of tensors."""
        parts = [f"{name}={list(value.shape)}" for name, value in vars(self).items() if isinstance(value, Tensor)]
        if self.ray_maps is not None:
            parts.append(f"ray_maps={[list(ray_map.transmittance.shape) for ray_map in self.ray_maps]}")
        return f"Rendering({', '.join(parts)}, {self.images.dtype} on {self.images.device})"

    def channel(self, index: int) -> Float[Tensor, "v rows columns"]:
        """Return the images of one channel: see `channel_of`."""
        return channel_of(self.images, index)


@checks_arguments
def channel_of(images: Float[Tensor, "v c rows columns"], index: int) -> Float[Tensor, "v rows columns"]:
    """Return the images of one channel [V, rows, columns].

    Raises
    ------
    SarsplatError
        If there is no such channel.
    """
    count = images.shape[1]
    if not 0 <= index < count:
        raise SarsplatError(f"there is no channel {index} in images of {count}; give one from 0 to {count - 1}")
    return images.squeeze(1) if count == 1 else images[:, index]  # the gradient of a slice is filled up with zeros
