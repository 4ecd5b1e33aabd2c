"""An echo: what it needs to know of a rendering, and what it adds to the images.

The engines render the direct return of the Gaussians in one pass, which also says where rays end and how much of each
Gaussian is seen. Every other return is an echo of its own and is added to the images in the channel of power.
"""

from __future__ import annotations

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
from sarsplat.renderer.engines.chosen_views import candidates
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.rendering import RayMap


@dataclass(frozen=True)
class RayEnds:
    """T_end of the rays of all views, row by row, one view after the other.

    Of `ChosenViews`, sizes and origins are those of all that may be chosen, and each of the V views has as many rays.

    Parameters
    ----------
    transmittance : Tensor [R]
        Of every ray.
    sizes : sequence of (rows, columns), one per view
        Of the views' lattices.
    origins : sequence of (x_r, y_r), one per view
        Where their first rays are, m.
    """

    transmittance: Float[Tensor, " rays"]
    sizes: Sequence[tuple[int, int]]
    origins: Sequence[tuple[float, float]]


def ends_of(ray_maps: Sequence[RayMap]) -> RayEnds:
    """Where the rays of ray maps end."""
    sizes = [(one.transmittance.shape[0], one.transmittance.shape[1]) for one in ray_maps]
    left = torch.cat([one.transmittance.flatten() for one in ray_maps])
    return RayEnds(left, sizes, [one.origin for one in ray_maps])


@dataclass(frozen=True)
class Sighting:
    """What is known of some views once their Gaussians are rendered.

    Parameters
    ----------
    gaussians : Gaussians
        The scene, N Gaussians.
    views : sequence of View
        V of them.
    grid : ImageGrid
        Of the images.
    rays : RayGrid
        Of the computation plane.
    shift : Tensor [V, 2] or None
        Displacement (azimuth, range) of each image, m.
    lit_area : Tensor [V, N]
        Area across the line of sight over which each Gaussian is seen, m²; differentiable only by the steps of a
        rendering (`sarsplat.attenuate`).
    ends : RayEnds or None
        What is left of the rays behind all Gaussians, if an echo wants it.
    new_pass : NewPass or None
        Engine for `Operation.on`; None where plain torch calculates.
    cuts : bool
        Whether plain torch leaves out what it may of footprints.
    """

    gaussians: Gaussians
    views: Sequence[View]
    grid: ImageGrid
    rays: RayGrid
    shift: Float[Tensor, "v 2"] | None
    lit_area: Float[Tensor, "v n"]
    ends: RayEnds | None
    new_pass: NewPass | None
    cuts: bool = True


class Echo(ABC):
    """Base of the echoes: one return of a scene, differentiable with respect to its own tensors and the scene's."""

    way: ClassVar[str] = "echo"
    """How it returns, in words."""

    wants_ray_ends: ClassVar[bool] = False
    """Whether it is told where rays end."""

    within_bounds: ClassVar[bool] = True
    """Whether it renders nothing beyond the scene's `Bounds`."""

    def check(self, gaussians: Gaussians) -> None:
        """Raise a SarsplatError if it does not fit the scene."""
        return

    def values(self) -> dict[str, Tensor | None]:
        """Its tensors that must be in range, by name."""
        return {}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians, as far as what it stands for does not hide them from everywhere."""
        return gaussians

    def in_sight(
        self,
        means: Float[Tensor, "n 3"],
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v n"] | None:
        """1 for Gaussians that it leaves in sight of a view, 0 for those that it hides; None if it hides none."""
        return None

    @abstractmethod
    def seen(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        """What the views show of it."""

    def returned(
        self,
        seen: Float[Tensor, "v rows columns"],
        views: Sequence[View],
        grid: ImageGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v rows columns"]:
        """β⁰ of what the views show of it, linear power."""
        return seen


def check_echoes(
    echoes: Sequence[Echo], gaussians: Gaussians, views: Sequence[View], channels: int, imaging_weight: str
) -> None:
    """Refuse echoes in images that cannot have any, and those that do not fit the scene."""
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
    """The Gaussians, as far as no echo hides them from everywhere."""
    for echo in echoes:
        left = echo.visible(gaussians)
        if (len(left), left.means.dtype, left.means.device) != (
            len(gaussians),
            gaussians.means.dtype,
            gaussians.means.device,
        ):
            raise SarsplatError(
                f"{type(echo).__name__}.visible makes {len(gaussians)} Gaussians to {len(left)}, or of another kind; "
                "set the optical depth of hidden ones to 0"
            )
        gaussians = left
    return gaussians


def left_in_sight(
    echoes: Sequence[Echo],
    means: Float[Tensor, "n 3"],
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Float[Tensor, "v n"] | None:
    """`Echo.in_sight` of all echoes together."""
    masks = [mask for echo in echoes if (mask := echo.in_sight(means, views, grid, rays, shift)) is not None]
    if not masks:
        return None
    for mask in masks:
        if not isinstance(mask, Tensor) or mask.shape != (len(views), len(means)):
            found = tuple(mask.shape) if isinstance(mask, Tensor) else type(mask).__name__
            raise SarsplatError(f"an echo's in_sight gave {found}; it must give a tensor {(len(views), len(means))}")
    return (torch.stack(masks).prod(0) if len(masks) > 1 else masks[0]).to(means).contiguous()  # kernels read it


def added(images: Float[Tensor, "v c h w"], returned: Float[Tensor, "v h w"], channel: int) -> Float[Tensor, "v c h w"]:
    """Images with what an echo returned in their channel of power."""
    shape = (len(images), *images.shape[2:])
    if not isinstance(returned, Tensor) or returned.shape != shape or returned.dtype != images.dtype:
        found = f"{returned.dtype} {tuple(returned.shape)}" if isinstance(returned, Tensor) else type(returned).__name__
        raise SarsplatError(f"an echo returned {found}; it must return {images.dtype} {shape}")
    power = torch.arange(images.shape[1], device=images.device) == channel
    return images + (returned[:, None] if len(power) == 1 else returned[:, None] * power.to(images)[:, None, None])
