"""Echoes: their base class, the state of a rendering that they read, and their addition to the images.

The engines render the direct return of the Gaussians in one pass, with lit areas and ends of rays. Every other return
is an echo, whose images are added in the channel of power.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.engines.on_device import candidates
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.rendering import RayMap


@dataclass(frozen=True)
class RayEnds:
    """T_end of the rays of all views, row by row, one view after the other.

    `transmittance` [R] is the two-way one behind all Gaussians; of each view, `sizes` are rows and columns of its
    lattice, and `origins` the position (x_r, y_r) of its first ray, m. For `ChosenViews`, sizes and origins are
    those of all candidates, and each of the V views has equally many rays.
    """

    transmittance: Float[Tensor, " rays"]
    sizes: Sequence[tuple[int, int]]
    origins: Sequence[tuple[float, float]]


def ends_of(ray_maps: Sequence[RayMap]) -> RayEnds:
    """Collect T_end of ray maps."""
    sizes = [(one.transmittance.shape[0], one.transmittance.shape[1]) for one in ray_maps]
    left = torch.cat([one.transmittance.flatten() for one in ray_maps])
    return RayEnds(left, sizes, [one.origin for one in ray_maps])


@dataclass(frozen=True)
class Sighting:
    """Scene, views and attenuation after the Gaussians are rendered; input of the echoes.

    Parameters
    ----------
    gaussians, views, grid, rays, shift
        As at `sarsplat.render`, N Gaussians and V views.
    lit_area : Tensor [V, N]
        Area across the line of sight over which each Gaussian is seen, m²; differentiable only by the steps of a
        rendering (`sarsplat.attenuate`).
    ends : RayEnds or None
        Transmittance of the rays behind all Gaussians, if an echo asks for it.
    new_pass : NewPass or None
        Engine for `Operation.on`; None where plain torch calculates.
    """

    gaussians: Gaussians
    views: Sequence[View]
    grid: ImageGrid
    rays: RayGrid
    shift: Float[Tensor, "v 2"] | None
    lit_area: Float[Tensor, "v n"]
    ends: RayEnds | None
    new_pass: NewPass | None


class Echo(ABC):
    """Base of the echoes: one return of a scene, differentiable with respect to its own tensors and the scene's."""

    way: ClassVar[str] = "echo"
    """Words for its path, as a name of its share of the power."""

    wants_ray_ends: ClassVar[bool] = False
    """True if it uses `Sighting.ends`."""

    within_bounds: ClassVar[bool] = True
    """True if it renders nothing beyond the scene's `Bounds`."""

    def check(self, gaussians: Gaussians) -> None:
        """Raise a SarsplatError if it does not fit the scene."""
        return

    def values(self) -> dict[str, Tensor | None]:
        """Return the tensors that must be in range, by name."""
        return {}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians, with optical depth 0 where it hides them in every view."""
        return gaussians

    def in_sight(
        self,
        means: Float[Tensor, "n 3"],
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v n"] | None:
        """Return 1 for Gaussians in sight of a view, 0 for those that it hides from it; None if it hides none."""
        return None

    @abstractmethod
    def returned(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        """Return its images: β⁰, linear power."""


def check_echoes(
    echoes: Sequence[Echo], gaussians: Gaussians, views: Sequence[View], channels: int, imaging_weight: str
) -> None:
    """Raise if images cannot have echoes, or an echo does not fit the scene."""
    if not echoes:
        return
    if imaging_weight == "peak":
        raise SarsplatError("imaging_weight='peak' gives images without a unit, to which no ground can be added")
    channel = gaussians.scattering.power_channel
    if channel >= channels:
        raise SarsplatError(
            f"the ground and other echoes return power in channel {channel}, but amplitudes have {channels} channels; "
            "give those of all its channels"
        )
    if any(view.aloft for view in candidates(views)[0]):
        raise SarsplatError("a view is of a target aloft, where there is no ground; render it without ground")
    for echo in echoes:
        echo.check(gaussians)


def all_visible(echoes: Sequence[Echo], gaussians: Gaussians) -> Gaussians:
    """Apply `Echo.visible` of all echoes."""
    for echo in echoes:
        visible = echo.visible(gaussians)
        before, after = gaussians.means, visible.means
        if (len(after), after.dtype, after.device) != (len(before), before.dtype, before.device):
            raise SarsplatError(
                f"{type(echo).__name__}.visible makes {len(before)} Gaussians to {len(after)}, or of another kind; "
                "set the optical depth of hidden ones to 0"
            )
        gaussians = visible
    return gaussians


def left_in_sight(
    echoes: Sequence[Echo],
    means: Float[Tensor, "n 3"],
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Float[Tensor, "v n"] | None:
    """Combine `Echo.in_sight` of all echoes."""
    masks = [mask for echo in echoes if (mask := echo.in_sight(means, views, grid, rays, shift)) is not None]
    if not masks:
        return None
    for mask in masks:
        _check_given("in_sight", mask, (len(views), len(means)))
    return (torch.stack(masks).prod(0) if len(masks) > 1 else masks[0]).to(means).contiguous()  # kernels read it


def _check_given(method: str, given: object, shape: tuple[int, ...], dtype: torch.dtype | None = None) -> None:
    """Raise unless an echo's method gave a tensor of that shape and, if any, dtype."""
    if not isinstance(given, Tensor) or given.shape != shape or given.dtype != (dtype or given.dtype):
        found = f"{given.dtype} {tuple(given.shape)}" if isinstance(given, Tensor) else type(given).__name__
        raise SarsplatError(f"an echo's {method} gave {found}; it must give a tensor {shape} of {dtype or 'any dtype'}")


def with_echoes(
    images: Float[Tensor, "v c h w"], echoes: Sequence[Echo], sighting: Sighting
) -> tuple[Float[Tensor, "v c h w"], tuple[Float[Tensor, "v h w"], ...]]:
    """Return images with all echoes added in the channel of power, and the images of each echo."""
    returns = tuple(echo.returned(sighting) for echo in echoes)
    shape = (len(images), *images.shape[2:])
    for returned in returns:
        _check_given("returned", returned, shape, images.dtype)
        beta0, channels = returned[:, None], torch.arange(images.shape[1], device=images.device)
        of_power = channels == sighting.gaussians.scattering.power_channel
        images = images + (beta0 if len(channels) == 1 else beta0 * of_power.to(images)[:, None, None])
    return images, returns
