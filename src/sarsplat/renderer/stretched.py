"""Rendering of views with a stretched azimuth, by the steps of a rendering.

Gaussians are lit as in the unstretched view, and imaged by the gradients of the look.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.view import unstretched
from sarsplat.renderer.engines.on_device import ChosenViews, NotRecordable
from sarsplat.renderer.operations import Steps, amplitudes_towards
from sarsplat.renderer.rendering import Footprints, Rendering, footprints_of, scaled


def render_stretched(
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
) -> Rendering:
    """Run `sarsplat.render` for views that may be stretched; arguments are documented there."""
    if isinstance(views, ChosenViews):
        raise NotRecordable("is stretched")
    g = gaussians
    unlit = replace(g, scattering=Harmonics(g.means.new_zeros(len(g), 1)))  # unused
    projection = steps.project(unlit, unstretched(views), grid, rays=rays)
    lit_area = steps.attenuate(projection, rays).lit_area
    if amplitudes is None:
        amplitudes = amplitudes_towards(steps.new_pass, g, views)
    cross_sections = amplitudes * lit_area[..., None]
    footprints = imaged(g, views, grid, shift)
    planes = None
    if plane_gradients:
        planes = g.means.new_zeros(len(views), len(g), 4)
        for centers, part in zip((projection.rays.centers, footprints.centers), planes.split(2, dim=-1), strict=True):
            if centers.requires_grad:
                centers.register_hook(partial(_keep, part))
    images = steps.splat(footprints, cross_sections, grid, imaging_weight=imaging_weight)
    return Rendering(scaled(images, gain), cross_sections, lit_area.detach(), plane_gradients=planes)


def imaged(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, shift: Float[Tensor, "v 2"] | None
) -> Footprints:
    """Return footprints on the imaging plane by the gradients of any look."""
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


def _keep(part: Float[Tensor, "v n 2"], gradient: Float[Tensor, "v n 2"]) -> None:
    """Copy a gradient in the backward pass."""
    part.copy_(gradient.detach())
