"""Images of a transmitter and a receiver apart, or stretched, put together from the steps of a rendering.

The way in is u_t and the way out u_r. A Gaussian is imaged where the look's gradients say, in slant range
−½(u_t + u_r)·x, and lit both ways: over √(lit(u_t)·lit(u_r)). What it returns per lit area is what its law says of the
direction halfway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.both_ways import both_ways
from sarsplat.renderer.echoes.echo import Sighting, added
from sarsplat.renderer.echoes.ground import GroundEcho
from sarsplat.renderer.echoes.ground_two_ways import ground_two_ways
from sarsplat.renderer.engines.chosen_views import ChosenViews
from sarsplat.renderer.engines.on_device import NotRecordable
from sarsplat.renderer.footprints import Footprints, footprints_of
from sarsplat.renderer.lobes import amplitudes_towards
from sarsplat.renderer.one_by_one import Steps
from sarsplat.renderer.rendering import Rendering

_ANY_DEPTH = 1.0
"""Of first returns, which come with what is left of rays, and are not used."""


def render_by_steps(
    steps: Steps,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    amplitudes: Float[Tensor, "v n c"] | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    gain: Float[Tensor, " v"] | None = None,
    imaging_weight: str = "area",
    plane_gradients: bool = False,
    ground: GroundEcho | None = None,
) -> Rendering:
    """`sarsplat.render` of views some or all of which are not plain; arguments are documented there.

    `ground` is a plane, which has hidden what is below it already.
    """
    if isinstance(views, ChosenViews):
        raise NotRecordable("has a transmitter and a receiver apart, or is stretched")
    g = gaussians
    ends = (0, -1) if ground is not None or any(view.apart_deg for view in views) else (0,)
    ways = [view.legs[end] for end in ends for view in views]
    unlit = replace(g, scattering=Harmonics(g.means.new_zeros(len(g), 1)))  # nobody asks what returns along either way
    projection = steps.project(unlit, ways, grid, rays)
    attenuation = steps.attenuate(projection, rays, None if ground is None else _ANY_DEPTH)
    lit_area, *back = attenuation.lit_area.split(len(views))
    if back:
        lit_area = both_ways(lit_area, back[0])
    if amplitudes is None:
        amplitudes = amplitudes_towards(steps.new_pass, g, views)
    cross_sections = amplitudes * lit_area[..., None]
    places = imaged(g, views, grid, shift)
    planes = None
    if plane_gradients:
        planes = g.means.new_zeros(len(views), len(g), 4)
        _filled_later(planes, projection.rays.centers, places.centers)
    images = steps.splat(places, cross_sections, grid, imaging_weight)
    returns: tuple[Tensor, ...] = ()
    if ground is not None:
        assert attenuation.ray_maps is not None  # asked for
        sighting = Sighting(g, views, grid, rays, shift, lit_area, None, steps.new_pass)
        returns = (ground_two_ways(ground, attenuation.ray_maps, sighting),)
        images = added(images, returns[0], g.scattering.power_channel)
    if gain is not None:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        images = images * gain[:, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
    return Rendering(images, cross_sections, lit_area.detach(), plane_gradients=planes, echoes=returns)


def imaged(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, shift: Float[Tensor, "v 2"] | None
) -> Footprints:
    """Footprints on the imaging plane by the gradients of any looks."""
    means = gaussians.means
    with torch.autocast(means.device.type, enabled=False):
        gradients = torch.from_numpy(np.stack([view.look.gradients for view in views])).to(means)  # [V, 2, 3]
        centers = means @ gradients.mT
        if shift is not None:
            centers = centers + shift[:, None]
        sides = gradients[:, None] @ (rotation_matrix(gaussians.quaternions) * gaussians.scales[:, None])
        of_azimuth, of_range = sides.unbind(2)  # [V, N, 3]: their products are the covariance
        variances = of_azimuth.square().sum(2), (of_azimuth * of_range).sum(2), of_range.square().sum(2)
        flat = torch.linalg.cross(of_azimuth, of_range).square().sum(2)
        return footprints_of(centers, variances, flat, grid)


def _filled_later(
    planes: Float[Tensor, "v n 4"], of_rays: Float[Tensor, "w n 2"], of_pixels: Float[Tensor, "v n 2"]
) -> None:
    """Gradients on the planes once they are there; on the computation plane, of both ways together."""

    def on_rays(slope: Tensor) -> None:
        planes[..., :2] = slope.detach().unflatten(0, (-1, len(planes))).sum(0)

    def on_pixels(slope: Tensor) -> None:
        planes[..., 2:] = slope.detach()

    for centers, fill in ((of_rays, on_rays), (of_pixels, on_pixels)):
        if centers.requires_grad:
            centers.register_hook(fill)
