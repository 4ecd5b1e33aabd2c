"""A rendering step by step: project, attenuate and splat give what `render` gives in one call."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View


def chained(
    steps: Any,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid | None,
    imaging_weight: str,
    first_return_depth: float | None,
    amplitudes: Tensor | None = None,
    shift: Tensor | None = None,
    gain: Tensor | None = None,
) -> SimpleNamespace:
    """With these steps; as a rendering is."""
    rays = rays or RayGrid.for_image(grid)
    p = steps.project(gaussians, views, grid, rays=rays, shift=shift)
    lit = steps.attenuate(p, rays, first_return_depth=first_return_depth)
    cross_sections = (p.amplitudes if amplitudes is None else amplitudes) * lit.lit_area[..., None]
    images = steps.splat(p.pixels, cross_sections, grid, imaging_weight=imaging_weight)
    images = images if gain is None else images * gain[:, None, None, None]
    made = {"images": images, "cross_sections": cross_sections, "lit_area": lit.lit_area}
    return SimpleNamespace(**made, ray_maps=lit.ray_maps, echoes=())
