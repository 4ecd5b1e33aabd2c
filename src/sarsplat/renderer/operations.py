"""A whole rendering and its steps one by one, as the renderer calls them, on an engine's passes."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import check_values
from sarsplat.renderer.echoes.echo import Echo, RayEnds, Sighting, added, left_in_sight
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.bounds import Bounds
from sarsplat.renderer.engines.chosen_views import by_view
from sarsplat.renderer.engines.passes import NewPass, Pass
from sarsplat.renderer.engines.problem import foot_shift
from sarsplat.renderer.engines.stages import Attenuate, Bounce, PressedFlat, Project, Render, Splat
from sarsplat.renderer.footprints import Attenuation, Footprints, Projection, Waves
from sarsplat.renderer.lobes import amplitudes_towards
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
    """`sarsplat.render` on an engine's passes; arguments are documented there. With bounds, no value is looked at."""
    if gain is not None and bounds is not None:
        bounds.watch(gain)
    else:
        check_values({"gain": gain})  # the rest is checked on the way in
    if bounds is None and echoes:  # which use these before the engine looks at them
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
    seen = [echo.seen(sighting) for echo in echoes]
    returns = [echo.returned(one, views, grid, shift) for echo, one in zip(echoes, seen, strict=True)]
    for one in returns:
        images = added(images, one, g.scattering.power_channel)
    if gain is not None:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        images = images * gain[:, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
    return Rendering(images, cross_sections, lit_area.detach(), _ray_maps(step, traced), planes, tuple(returns))


def project_with(
    new_pass: NewPass,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Projection:
    """`sarsplat.project` on an engine's passes."""
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
    """On the imaging plane, of Gaussians pressed flat onto a plane of this height."""
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
    """What returns by way of a mirror at a height, of Gaussians that were rendered: lit so far, and so far rays came.

    Power is the factor times √(lit · lit by way of the mirror) times amplitudes; without these, of harmonics.
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
    """`sarsplat.attenuate` on an engine's passes."""
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
    """`sarsplat.splat` on an engine's passes; with waves, real and imaginary parts in turn."""
    turns = None if waves is None else (waves.numbers / (2 * math.pi)).contiguous()
    step = Splat(new_pass(), grid, imaging_weight == "peak", turns)
    slopes = None if waves is None else waves.slopes
    return step.of(footprints.centers, footprints.roots, cross_sections, slopes)[0]


# ---- what they share -------------------------------------------------------------------------------------------------
def _shift(gaussians: Gaussians, views: Sequence[View], shift: Tensor | None) -> Tensor:
    return gaussians.means.new_zeros(len(views), 2) if shift is None else shift


def _ray_ends(step: Render | Attenuate, transmittance: Tensor) -> RayEnds:
    """T_end of the rays of all views, and where they are."""
    lattices, (dx, dy) = step.kernel.lattices(step.problem.views), step.rays.spacing_m
    sizes = [(lattice.rows, lattice.columns) for lattice in lattices]
    return RayEnds(transmittance, sizes, [((lattice.k0x + 0.5) * dx, (lattice.k0y + 0.5) * dy) for lattice in lattices])


def _ray_maps(step: Render | Attenuate, traced: Sequence[Tensor]) -> tuple[RayMap, ...] | None:
    """What was traced, cut into the views' lattices; None if nothing was."""
    if step.depth is None:
        return None
    ends, maps = _ray_ends(step, traced[0]), []
    cut = [values.split([math.prod(size) for size in ends.sizes]) for values in traced]
    for left, first, size, origin in zip(*cut, ends.sizes, ends.origins, strict=True):
        maps.append(RayMap(left.view(size), first.view(size), origin))
    return tuple(maps)
