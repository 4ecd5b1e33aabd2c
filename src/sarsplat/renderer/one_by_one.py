"""The steps of a rendering, for what is put together from them: by an engine's passes or by the reference."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.footprints import Footprints, Projection
from sarsplat.renderer.operations import attenuate_with, project_with, splat_with
from sarsplat.renderer.reference import attenuate_reference, project_reference, splat_reference


class Steps:
    """The steps of a rendering, by an engine's passes or by the reference."""

    def __init__(self, new_pass: NewPass | None, cuts: bool) -> None:
        self.new_pass, self._cuts = new_pass, cuts

    def project(self, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> Projection:
        if self.new_pass is None:
            return project_reference(gaussians, views, grid, rays=rays)
        return project_with(self.new_pass, gaussians, views, grid, rays=rays, shift=None)

    def lit_area(self, projection: Projection, rays: RayGrid) -> Float[Tensor, "v n"]:
        if self.new_pass is None:
            return attenuate_reference(projection, rays, first_return_depth=None, cuts=self._cuts).lit_area
        return attenuate_with(self.new_pass, projection, rays, first_return_depth=None).lit_area

    def splat(
        self,
        footprints: Footprints,
        cross_sections: Float[Tensor, "v n c"],
        grid: ImageGrid,
        imaging_weight: str = "area",
    ) -> Float[Tensor, "v c rows columns"]:
        if self.new_pass is None:
            return splat_reference(footprints, cross_sections, grid, imaging_weight=imaging_weight, cuts=self._cuts)
        return splat_with(self.new_pass, footprints, cross_sections, grid, imaging_weight=imaging_weight)
