"""Results of renderings and of their steps: footprints of Gaussians on the two planes, lit areas, and images."""

from dataclasses import dataclass
from operator import attrgetter

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments, expect
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.gaussians import check_tensors
from sarsplat.geometry import ImageGrid


def _check_fields(owner: object, shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise unless the fields are floating tensors of these shapes, of one dtype and on one device."""
    v, n = next(iter(shapes.values()))[:2]
    check_tensors({name: attrgetter(name)(owner) for name in shapes}, shapes, f"{v} views of {n} Gaussians")


def _sizes(tensor: Tensor) -> tuple[int, int]:
    """Return V and N, the first two sizes of a tensor; zeros if it has fewer."""
    return (tensor.shape[0], tensor.shape[1]) if isinstance(tensor, Tensor) and tensor.ndim > 1 else (0, 0)


@dataclass(frozen=True)
class Footprints:
    """N Gaussians in V views on one plane: each is exp(−½|L d|²) at the displacement d from its centre.

    Parameters
    ----------
    centers : Tensor [V, N, 2]
        Positions on the plane, m.
    roots : Tensor [V, N, 3]
        (a, b, c), 1/m, of the triangular factor L = (a b; 0 c) of the inverse covariance, LᵀL = Σ'⁻¹; a and c are
        positive. A factor, because the covariance of a needle loses the digits that its inverse needs.

    Raises
    ------
    SarsplatError
        If shapes, dtypes or devices do not fit together.
    """

    centers: Float[Tensor, "v n 2"]
    roots: Float[Tensor, "v n 3"]

    def __post_init__(self) -> None:
        v, n = _sizes(self.centers)
        _check_fields(self, {"centers": (v, n, 2), "roots": (v, n, 3)})


@dataclass(frozen=True)
class Waves:
    """Phase gradients of complex channels across footprints, which follow the elevation within a Gaussian.

    At the displacement d from its centre on the imaging plane, a Gaussian's mean elevation is slopes · d higher than at
    the centre, and channel c turns by exp(j numbers[c] · slopes · d).

    Parameters
    ----------
    numbers : Tensor [V, C]
        Phase per elevation of each channel, rad/m; not differentiable.
    slopes : Tensor [V, N, 2]
        Elevation per displacement along azimuth and slant range; differentiable.

    Raises
    ------
    SarsplatError
        If shapes, dtypes or devices do not fit together.
    """

    numbers: Float[Tensor, "v c"]
    slopes: Float[Tensor, "v n 2"]

    def __post_init__(self) -> None:
        (v, n), (_, c) = _sizes(self.slopes), _sizes(self.numbers)
        _check_fields(self, {"slopes": (v, n, 2), "numbers": (v, c)})
        if self.numbers.requires_grad:
            raise SarsplatError("waves.numbers has no gradient; detach it, or learn the slopes")


def deviations(roots: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2"]:
    """Return standard deviations along the two axes of the plane, m: the roots of the diagonal of Σ'."""
    a, b, c = roots.unbind(-1)
    return torch.stack([(1 + (b / c) ** 2).sqrt() / a, 1 / c], dim=-1)


def footprints_of(
    centers: Float[Tensor, "v n 2"],
    variances: tuple[Float[Tensor, "v n"], Float[Tensor, "v n"], Float[Tensor, "v n"]],
    determinant: Float[Tensor, "v n"],
    grid: ImageGrid,
) -> Footprints:
    """Return footprints on the imaging plane, widened by the system's response.

    `variances` are the elements (azimuth, both, range) of the covariance, m². Its `determinant` is given: computed as a
    difference of products it would lose the digits of a needle.
    """
    of_azimuth, of_range = (centers.new_tensor(variance) for variance in grid.response_variance_m2)
    var_azimuth, both, var_range = variances
    determinant = determinant + var_azimuth * of_range + var_range * of_azimuth + of_azimuth * of_range
    var_range = var_range + of_range
    a = (var_range / determinant).sqrt()
    return Footprints(centers, torch.stack([a, -both / var_range * a, var_range.rsqrt()], dim=-1))


@dataclass(frozen=True)
class Projection:
    """N Gaussians in V views, on both planes; result of `project`.

    Parameters
    ----------
    rays : Footprints
        On the computation plane (x_r, y_r), widened by the cell of a ray; differentiable.
    optical_depth : Tensor [V, N]
        κ': two-way optical depth on a ray through the centre of a widened footprint; differentiable.
    range_m : Tensor [V, N]
        Range z_r of the centres, m: the order along the rays. Not differentiable.
    tilt : Tensor [V, N, 2]
        Slope of the range of the densest point against (x_r, y_r), for first returns. Not differentiable.
    pixels : Footprints
        On the imaging plane (x_r, z_r), widened by the system's response and shifted; differentiable.
    amplitudes : Tensor [V, N, C]
        Return of each channel per lit area, by the scattering law of the Gaussians; differentiable.

    Raises
    ------
    SarsplatError
        If shapes, dtypes or devices do not fit together.
    """

    rays: Footprints
    optical_depth: Float[Tensor, "v n"]
    range_m: Float[Tensor, "v n"]
    tilt: Float[Tensor, "v n 2"]
    pixels: Footprints
    amplitudes: Float[Tensor, "v n c"]

    def __post_init__(self) -> None:
        expect(Footprints, rays=self.rays, pixels=self.pixels)
        v, n = _sizes(self.optical_depth)
        c = self.amplitudes.shape[-1] if isinstance(self.amplitudes, Tensor) and self.amplitudes.ndim == 3 else 1
        shapes = {"optical_depth": (v, n), "range_m": (v, n), "tilt": (v, n, 2), "amplitudes": (v, n, c)}
        _check_fields(self, shapes | {"rays.centers": (v, n, 2), "pixels.centers": (v, n, 2)})


@dataclass(frozen=True)
class Attenuation:
    """Lit areas of Gaussians; result of `attenuate`.

    Parameters
    ----------
    lit_area : Tensor [V, N]
        A_c Σ_ρ w, m²: visible area of a Gaussian across the line of sight; differentiable. Times the amplitudes it is
        the radar cross-section in each channel.
    ray_maps : tuple of RayMap, one per view, or None
        On request (`first_return_depth`).
    """

    lit_area: Float[Tensor, "v n"]
    ray_maps: "tuple[RayMap, ...] | None" = None


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


def scaled(images: Float[Tensor, "v c rows columns"], gain: Float[Tensor, " v"] | None) -> Tensor:
    """Return images times their gains."""
    if gain is None:
        return images
    # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
    return images * gain[:, None, None, None].expand(-1, images.shape[1], 1, images.shape[3])


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
