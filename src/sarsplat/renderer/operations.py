"""Renderings and single steps on an engine's passes; steps on an engine or the reference."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import check_values
from sarsplat.renderer.echoes.echo import Echo, RayEnds, Sighting, left_in_sight, with_echoes
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.bounds import Bounds
from sarsplat.renderer.engines.chosen_views import by_view
from sarsplat.renderer.engines.passes import NewPass, Pass
from sarsplat.renderer.engines.problem import foot_shift
from sarsplat.renderer.engines.stages import Attenuate, Bounce, PressedFlat, Project, Render, Splat
from sarsplat.renderer.footprints import Attenuation, Footprints, Projection, Waves
from sarsplat.renderer.lobes import amplitudes_towards
from sarsplat.renderer.reference import (
    attenuate_reference,
    pressed_flat_reference,
    project_reference,
    splat_reference,
)
from sarsplat.renderer.rendering import RayMap, Rendering


# ---- what the renderer calls -----------------------------------------------------------------------------------------
def render_with(
    new_pass: NewPass,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    amplitudes: Float[Tensor, "v n c"] | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    gain: Float[Tensor, " v"] | None = None,
    imaging_weight: str = "area",
    echoes: Sequence[Echo] = (),
    first_return_depth: float | None = None,
    plane_gradients: bool = False,
    bounds: Bounds | None = None,
) -> Rendering:
    """Run `sarsplat.render` on an engine's passes; with bounds, without looking at values."""
    if gain is not None and bounds is not None:
        bounds.watch(gain)
    else:
        check_values({"gain": gain})  # the engine checks the rest
    if bounds is None and echoes:  # which use these before the engine checks them
        check_values({"means": gaussians.means, "shift": shift})
        for echo in echoes:
            check_values(echo.values())
    g = gaussians
    planes = g.means.new_zeros(len(views), len(g), 4) if plane_gradients else None
    harmonics = None
    if amplitudes is None and isinstance(g.scattering, Harmonics):
        harmonics = g.scattering.parameters  # kernels evaluate these themselves
    elif amplitudes is None:
        amplitudes = amplitudes_towards(new_pass, g, views)
    wants_ends = any(echo.wants_ray_ends for echo in echoes)
    step = Render(new_pass(), views, grid, rays, g.scattering.p_min)
    step.peak, step.depth, step.planes, step.ends = imaging_weight == "peak", first_return_depth, planes, wants_ends
    step.in_sight = left_in_sight(echoes, g.means, views, grid, rays, shift)
    images, cross_sections, lit_area, *traced = step.of(
        g.means, g.quaternions, g.scales, g.optical_depth, harmonics, amplitudes, _shift(g, views, shift)
    )
    ends = _ray_ends(step, traced[0]) if wants_ends else None
    sighting = Sighting(g, views, grid, rays, shift, lit_area, ends, new_pass)
    images, returns = with_echoes(images, echoes, sighting)
    if gain is not None:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        images = images * gain[:, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
    return Rendering(images, cross_sections, lit_area.detach(), _ray_maps(step, traced), planes, returns)


def project_with(
    new_pass: NewPass,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Projection:
    """Run `sarsplat.project` on an engine's passes."""
    g, law = gaussians, gaussians.scattering
    harmonics = law.parameters if isinstance(law, Harmonics) else None  # kernels evaluate these themselves
    ray_centers, ray_roots, depth, range_m, tilt, pixel_centers, pixel_roots, gamma0 = Project(
        new_pass(), views, grid, rays, law.p_min
    ).of(g.means, g.quaternions, g.scales, g.optical_depth, harmonics, None, _shift(g, views, shift))
    amplitudes = gamma0[..., None] if harmonics is not None else amplitudes_towards(new_pass, g, views)
    return Projection(
        Footprints(ray_centers, ray_roots), depth, range_m, tilt, Footprints(pixel_centers, pixel_roots), amplitudes
    )


def pressed_flat_with(
    new_pass: NewPass,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    shift: Float[Tensor, "v 2"] | None,
    height_m: float,
) -> Footprints:
    """Return footprints on the imaging plane of Gaussians pressed flat onto the plane z = `height_m`."""
    g, at_foot = gaussians, by_view(foot_shift, views, height_m, gaussians.means.device)
    moved = at_foot if shift is None else at_foot + shift
    flat = PressedFlat(new_pass(), views, grid, RayGrid.for_image(grid), 0.0)
    return Footprints(*flat.of(g.means, g.quaternions, g.scales, g.optical_depth, None, None, moved)[5:7])


def bounced_with(
    kernel: Pass,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    amplitudes: Float[Tensor, "v n 1"] | None,
    shift: Float[Tensor, "v 2"] | None,
    lit_area: Float[Tensor, "v n"],
    ends: RayEnds,
    height_m: float,
    factor: float,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """Return images of the bounce of rendered Gaussians off a mirror z = `height_m`, with their lit areas and ray ends.

    Power is the factor times √(lit area · lit area by way of the mirror) times amplitudes, by default of harmonics.
    """
    g, (dx, dy) = gaussians, rays.spacing_m
    lattices = [
        api.lattice(round(x / dx - 0.5), round(y / dy - 0.5), *size)
        for size, (x, y) in zip(ends.sizes, ends.origins, strict=True)
    ]
    step = Bounce(kernel, views, grid, rays, g.scattering.p_min, lattices, height_m, factor)
    harmonics = g.scattering.parameters if amplitudes is None else None
    at_foot = by_view(foot_shift, views, height_m, g.means.device)
    moved = at_foot if shift is None else at_foot + shift
    arrays = g.means, g.quaternions, g.scales, g.optical_depth, harmonics, amplitudes, moved
    return step.of(*arrays, ends.transmittance, lit_area)[0]


def attenuate_with(
    new_pass: NewPass, projection: Projection, rays: RayGrid, *, first_return_depth: float | None
) -> Attenuation:
    """Run `sarsplat.attenuate` on an engine's passes."""
    p = projection
    step = Attenuate(new_pass(), rays, first_return_depth)
    lit_area, *traced = step.of(p.rays.centers, p.rays.roots, p.optical_depth, p.range_m, p.tilt)
    return Attenuation(lit_area, _ray_maps(step, traced))


def splat_with(
    new_pass: NewPass,
    footprints: Footprints,
    cross_sections: Float[Tensor, "v n c"],
    grid: ImageGrid,
    *,
    waves: Waves | None = None,
    imaging_weight: str,
) -> Float[Tensor, "v c {grid.rows} {grid.columns}"]:
    """Run `sarsplat.splat` on an engine's passes; with waves, of alternating real and imaginary parts."""
    turns = None if waves is None else (waves.numbers / (2 * math.pi)).contiguous()
    step = Splat(new_pass(), grid, imaging_weight == "peak", turns)
    slopes = None if waves is None else waves.slopes
    return step.of(footprints.centers, footprints.roots, cross_sections, slopes)[0]


class Steps:
    """Steps of a rendering: by an engine's passes, or by the reference if `new_pass` is None."""

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

    def pressed_flat(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        shift: Float[Tensor, "v 2"] | None,
        height_m: float,
    ) -> Footprints:
        if self.new_pass is None:
            return pressed_flat_reference(gaussians, views, grid, shift=shift, height_m=height_m)
        return pressed_flat_with(self.new_pass, gaussians, views, grid, shift=shift, height_m=height_m)


# ---- what they share -------------------------------------------------------------------------------------------------
def _shift(gaussians: Gaussians, views: Sequence[View], shift: Tensor | None) -> Tensor:
    return gaussians.means.new_zeros(len(views), 2) if shift is None else shift


def _ray_ends(step: Render | Attenuate, transmittance: Tensor) -> RayEnds:
    """Return T_end of the rays of all views, and their positions."""
    lattices, (dx, dy) = step.kernel.lattices(step.problem.views), step.rays.spacing_m
    sizes = [(lattice.rows, lattice.columns) for lattice in lattices]
    return RayEnds(transmittance, sizes, [((lattice.k0x + 0.5) * dx, (lattice.k0y + 0.5) * dy) for lattice in lattices])


def _ray_maps(step: Render | Attenuate, traced: Sequence[Tensor]) -> tuple[RayMap, ...] | None:
    """Split traced rays into a ray map for each view; None if first returns were not requested."""
    if step.depth is None:
        return None
    ends, maps = _ray_ends(step, traced[0]), []
    cut = [values.split([math.prod(size) for size in ends.sizes]) for values in traced]
    for transmittance, first, size, origin in zip(*cut, ends.sizes, ends.origins, strict=True):
        maps.append(RayMap(transmittance.view(size), first.view(size), origin))
    return tuple(maps)
