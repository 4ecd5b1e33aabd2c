"""Renderings on an engine's passes, and their steps on an engine or the reference."""

import math
from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics, NormalLobes
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import check_values
from sarsplat.renderer.echoes.echo import Echo, RayEnds, Sighting, left_in_sight, with_echoes
from sarsplat.renderer.engines.bounds import Bounds
from sarsplat.renderer.engines.on_device import by_view
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.engines.problem import directions_to, foot_shift
from sarsplat.renderer.engines.stages import Attenuate, PressedFlat, Project, Render, Splat
from sarsplat.renderer.reference import attenuate_reference, pressed_flat_reference, project_reference, splat_reference
from sarsplat.renderer.rendering import Attenuation, Footprints, Projection, RayMap, Rendering, Waves, scaled


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
    return Rendering(scaled(images, gain), cross_sections, lit_area.detach(), _ray_maps(step, traced), planes, returns)


class Steps:
    """Steps of a rendering: by an engine's passes, or by the reference if `new_pass` is None."""

    def __init__(self, new_pass: NewPass | None) -> None:
        self.new_pass = new_pass

    def project(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        *,
        rays: RayGrid,
        shift: Float[Tensor, "v 2"] | None = None,
    ) -> Projection:
        """Run `sarsplat.project`."""
        if self.new_pass is None:
            return project_reference(gaussians, views, grid, rays=rays, shift=shift)
        g, law = gaussians, gaussians.scattering
        harmonics = law.parameters if isinstance(law, Harmonics) else None  # kernels evaluate these themselves
        ray_centers, ray_roots, depth, range_m, tilt, pixel_centers, pixel_roots, gamma0 = Project(
            self.new_pass(), views, grid, rays, law.p_min
        ).of(g.means, g.quaternions, g.scales, g.optical_depth, harmonics, None, _shift(g, views, shift))
        amplitudes = gamma0[..., None] if harmonics is not None else amplitudes_towards(self.new_pass, g, views)
        of_rays, of_pixels = Footprints(ray_centers, ray_roots), Footprints(pixel_centers, pixel_roots)
        return Projection(of_rays, depth, range_m, tilt, of_pixels, amplitudes)

    def attenuate(
        self, projection: Projection, rays: RayGrid, *, first_return_depth: float | None = None
    ) -> Attenuation:
        """Run `sarsplat.attenuate`."""
        p = projection
        if self.new_pass is None:
            return attenuate_reference(p, rays, first_return_depth=first_return_depth)
        step = Attenuate(self.new_pass(), rays, first_return_depth)
        lit_area, *traced = step.of(p.rays.centers, p.rays.roots, p.optical_depth, p.range_m, p.tilt)
        return Attenuation(lit_area, _ray_maps(step, traced))

    def splat(
        self,
        footprints: Footprints,
        cross_sections: Float[Tensor, "v n c"],
        grid: ImageGrid,
        *,
        waves: Waves | None = None,
        imaging_weight: str = "area",
    ) -> Float[Tensor, "v c rows columns"]:
        """Run `sarsplat.splat` of real channels; with waves, alternating real and imaginary parts."""
        if self.new_pass is None:
            return splat_reference(footprints, cross_sections, grid, waves=waves, imaging_weight=imaging_weight)
        turns, slopes = (None, None) if waves is None else (waves.numbers / (2 * math.pi), waves.slopes)
        step = Splat(self.new_pass(), grid, imaging_weight == "peak", None if turns is None else turns.contiguous())
        return step.of(footprints.centers, footprints.roots, cross_sections, slopes)[0]

    def pressed_flat(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        shift: Float[Tensor, "v 2"] | None,
        height_m: float,
    ) -> Footprints:
        """Return footprints on the imaging plane of Gaussians pressed flat onto the plane z = `height_m`."""
        if self.new_pass is None:
            return pressed_flat_reference(gaussians, views, grid, shift=shift, height_m=height_m)
        g, moved = gaussians, foot(gaussians, views, shift, height_m)
        flat = PressedFlat(self.new_pass(), views, grid, RayGrid.for_image(grid), 0.0)
        return Footprints(*flat.of(g.means, g.quaternions, g.scales, g.optical_depth, None, None, moved)[5:7])


# ---- what they share -------------------------------------------------------------------------------------------------
def _shift(gaussians: Gaussians, views: Sequence[View], shift: Tensor | None) -> Tensor:
    return gaussians.means.new_zeros(len(views), 2) if shift is None else shift


def foot(gaussians: Gaussians, views: Sequence[View], shift: Tensor | None, height_m: float) -> Tensor:
    """Return the displacement in each image of feet at z = `height_m`."""
    at_foot = by_view(foot_shift, views, height_m, gaussians.means.device)
    return at_foot if shift is None else at_foot + shift


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


# ---- amplitudes of the default scattering law ------------------------------------------------------------------------
def amplitudes_towards(new_pass: NewPass | None, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v n c"]:
    """Return `Gaussians.amplitudes` towards the radar of each view, by an engine; by plain torch if None."""
    return amplitudes_along(new_pass, gaussians, directions_to(views, gaussians.means))


def amplitudes_along(
    new_pass: NewPass | None, gaussians: Gaussians, directions: Float[Tensor, "v 3"]
) -> Float[Tensor, "v n c"]:
    """Return `Gaussians.amplitudes` along unit vectors, by an engine; by plain torch if None."""
    law = gaussians.scattering
    if type(law) is not NormalLobes:
        return gaussians.amplitudes(directions)
    inputs = directions, gaussians.quaternions, gaussians.scales, law.parameters
    return Lobes(law.p_min).on(new_pass, *inputs)


class Lobes(Operation):
    """Operation of `NormalLobes.amplitudes`, without a gradient of the scales."""

    operation = "normal_lobes"
    names = ("directions", "quaternions", "scales", "parameters")

    def __init__(self, p_min: float) -> None:
        self.p_min = p_min

    def plain(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        parameters: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n 1"]:
        return NormalLobes(parameters, self.p_min).amplitudes(directions, quaternions, scales)

    def numbers(self, directions: Tensor, quaternions: Tensor, *_: Tensor) -> dict[str, Any]:
        return {"views": len(directions), "p_min": self.p_min, "gaussians": len(quaternions)}

    def outputs(self, directions: Tensor, quaternions: Tensor, *_: Tensor) -> dict[str, Tensor]:
        return {"amplitudes": directions.new_empty(len(directions), len(quaternions), 1)}
