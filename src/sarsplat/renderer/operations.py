"""What an engine calculates: a whole rendering and its steps one by one; and what is wrong with inputs, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.processes import Processes
from sarsplat.renderer.checks import check_values, complaint, complaint_by_view
from sarsplat.renderer.engines import structs
from sarsplat.renderer.engines.bounds import Bounds
from sarsplat.renderer.engines.cpu import FAULTS
from sarsplat.renderer.engines.operation import Operation, Tensors
from sarsplat.renderer.engines.passes import Pass
from sarsplat.renderer.engines.problem import ARRAYS, new_problem, point_at, pointer, problem_of
from sarsplat.renderer.footprints import Attenuation, Footprints, Projection, Waves, deviations
from sarsplat.renderer.ground import gamma0_by_view, ground_values, in_sight, lit, returned, with_ground
from sarsplat.renderer.lit_ground import RayEnds
from sarsplat.renderer.lobes import amplitudes_towards
from sarsplat.renderer.rendering import RayMap, Rendering
from sarsplat.renderer.shared import Branch, shared

_WIDTHS = (2, 3, None, None, 2, 2, 3, None)  # of the tensors [V, N, …] of a projection, as in structs.Projection

_BY_VIEW = ("amplitudes", "shift")
"""Arrays of a problem with a row for each view."""

NewPass = Callable[[], Pass]


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
    ground: Ground | None = None,
    first_return_depth: float | None = None,
    plane_gradients: bool = False,
    bounds: Bounds | None = None,
    processes: Processes | None = None,
) -> Rendering:
    """`sarsplat.render` on an engine's passes; arguments are documented there. With bounds, no value is looked at."""
    if gain is not None and bounds is not None:
        bounds.watch(gain)
    else:
        check_values({"gain": gain})  # the rest is checked on the way in
    if ground is not None and bounds is None:
        check_values(ground_values(ground))
    g = gaussians
    planes = g.means.new_zeros(len(views), len(g), 4) if plane_gradients else None
    harmonics = None
    if amplitudes is None and isinstance(g.scattering, Harmonics):
        harmonics = g.scattering.parameters  # kernels evaluate these themselves
    elif amplitudes is None:
        amplitudes = amplitudes_towards(new_pass, g, views)
    ray_maps: tuple[RayMap, ...] | None = None

    def some(branch: Branch, arrays: Tensors) -> tuple[Tensor, ...]:
        """Images, cross-sections, lit areas and, with a ground, what of it is lit in some of the views."""
        nonlocal ray_maps
        few, (*of_problem, displaced, gamma0) = views[slice(*branch)], arrays
        part = _Render(new_pass(), few, grid, rays, g.scattering.p_min)
        part.peak, part.depth, part.of_views = imaging_weight == "peak", first_return_depth, len(views)
        part.planes, part.ends = None if planes is None else planes[slice(*branch)], ground is not None
        moved = None if shift is None else displaced
        part.in_sight = in_sight(g.means, ground, few, grid, rays, moved)
        images, cross_sections, lit_area, *traced = part.of(*of_problem, displaced)
        ray_maps = _ray_maps(part, traced)
        if ground is None:
            return images, cross_sections, lit_area
        ends = _ray_ends(part, traced[0])
        seen = lit(ends, ground, gamma0, few, grid, rays, moved)
        return images, cross_sections, lit_area, seen

    by_view = _shift(g, views, shift), None if ground is None else gamma0_by_view(ground, len(views))
    arrays = (g.means, g.quaternions, g.scales, g.optical_depth, harmonics, amplitudes, *by_view)
    if processes is None:
        seen = some((0, len(views)), arrays)
    else:
        channels = len(g.scattering.channels) if amplitudes is None else amplitudes.shape[2]
        size = grid.rows, grid.columns
        shapes = [(channels, *size), (len(g), channels), (len(g),), *([] if ground is None else [size])]
        cut = [*(name in _BY_VIEW for name in ARRAYS), True]
        seen = shared(processes, some, arrays, cut, len(views), shapes, planes)
    images, cross_sections, lit_area, *ends = seen
    of_ground = None
    if ground is not None:
        of_ground = returned(ground, ends[0], views, grid, shift)
        images = with_ground(images, of_ground, g.scattering.power_channel)
    if gain is not None:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        images = images * gain[:, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
    return Rendering(images, cross_sections, lit_area.detach(), ray_maps, planes, of_ground)


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
    ray_centers, ray_roots, depth, range_m, tilt, pixel_centers, pixel_roots, gamma0 = _Project(
        new_pass(), views, grid, rays, law.p_min
    ).of(g.means, g.quaternions, g.scales, g.optical_depth, harmonics, None, _shift(g, views, shift))
    amplitudes = gamma0[..., None] if harmonics is not None else amplitudes_towards(new_pass, g, views)
    return Projection(
        Footprints(ray_centers, ray_roots), depth, range_m, tilt, Footprints(pixel_centers, pixel_roots), amplitudes
    )


def attenuate_with(
    new_pass: NewPass, projection: Projection, rays: RayGrid, *, first_return_depth: float | None
) -> Attenuation:
    """`sarsplat.attenuate` on an engine's passes."""
    p = projection
    step = _Attenuate(new_pass(), rays, first_return_depth)
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
    step = _Splat(new_pass(), grid, imaging_weight == "peak", turns)
    slopes = None if waves is None else waves.slopes
    return step.of(footprints.centers, footprints.roots, cross_sections, slopes)[0]


# ---- the operations --------------------------------------------------------------------------------------------------
class _OfGaussians(Operation):
    """An operation whose inputs are the arrays of a problem."""

    names = ARRAYS
    peak = False
    of_views: int | None = None
    """Of so many views these are a part; None: they are all."""

    def __init__(self, kernel: Pass, views: Sequence[View], grid: ImageGrid, rays: RayGrid, p_min: float) -> None:
        super().__init__(kernel)
        self.views, self.grid, self.rays, self.p_min = views, grid, rays, p_min

    def pose(self, inputs: Tensors) -> Any:
        """The problem of these inputs."""
        self.problem, self.constants = problem_of(inputs, self.views, self.grid, self.rays, self.p_min, self.peak)
        self.problem.of_views = self.of_views or len(self.views)
        return self.problem

    def accept(self, inputs: Tensors, fault: str, index: int) -> None:
        """Raise what the kernel rejected, if anything."""
        if not fault:
            return
        means, _, scales, *_ = inputs
        if fault == "lattice":
            assert means is not None
            assert scales is not None
            raise SarsplatError(_too_many_rays(index, self.rays, float(means.abs().max()), float(scales.max())))
        tensor = inputs[FAULTS.index(fault) - 1]
        assert tensor is not None
        raise SarsplatError((complaint_by_view if fault == "amplitudes" else complaint)(fault, tensor, index))


class _Render(_OfGaussians):
    """One call each way for all views: images, cross-sections, lit areas, and what the rays met."""

    depth: float | None
    ends: bool
    in_sight: Float[Tensor, "v n"] | None
    planes: Float[Tensor, "v n 4"] | None
    constant = (2, 4)

    def forward(self, inputs: Tensors) -> tuple[Tensor, ...]:
        problem, means = self.pose(inputs), inputs[0]
        assert means is not None
        problem.in_sight = pointer(self.in_sight)
        views, n, channels = problem.views, problem.gaussians, problem.channels
        # never torch's default dtype or device
        images = means.new_empty(views, channels, self.grid.rows, self.grid.columns)
        cross_sections, lit_area = means.new_empty(views, n, channels), means.new_empty(views, n)
        outputs = structs.Outputs(*map(pointer, (images, cross_sections, lit_area)))
        self.accept(inputs, *self.kernel.forward("render", problem, outputs))
        return images, cross_sections, lit_area, *_traced(self.kernel, problem, self.depth, self.ends, lit_area)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        d_images, d_cross_sections, _, d_transmittance, _ = grads
        if d_images is None:
            shape = self.problem.views, self.problem.channels, self.grid.rows, self.grid.columns
            d_images = saved[0].new_zeros(shape)
        results = [None if t is None else torch.empty_like(t) for t in saved]
        seeds = d_images, d_cross_sections, d_transmittance
        gradients = structs.Gradients(*map(pointer, (*seeds, *results, self.planes)))
        point_at(self.problem, saved)
        self.kernel.backward("render", self.problem, gradients)
        return results


class _Project(_OfGaussians):
    """To the tensors of a projection, the last of which is γ⁰ of harmonics."""

    def forward(self, inputs: Tensors) -> tuple[Tensor, ...]:
        problem, means = self.pose(inputs), inputs[0]
        assert means is not None
        outputs = tuple(_by_view(means, problem, width) for width in _WIDTHS)
        self.accept(inputs, *self.kernel.forward("project", problem, structs.Projection(*map(pointer, outputs))))
        self.constant = (3, 4) if problem.coefficients else (3, 4, 7)
        return outputs

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        seeds = [
            None if k in (3, 4) else _by_view(saved[0], self.problem, width).zero_() if grad is None else grad
            for k, (grad, width) in enumerate(zip(grads, _WIDTHS, strict=True))  # neither range nor tilt
        ]
        results = [None if t is None else torch.empty_like(t) for t in saved]
        gradients = structs.Gradients(**dict(zip(ARRAYS, map(pointer, results), strict=True)))
        point_at(self.problem, saved)
        self.kernel.backward("project", self.problem, structs.Projection(*map(pointer, seeds)), gradients)
        return results


class _Attenuate(Operation):
    """Footprints to lit areas, and what the rays met."""

    names = ("rays.centers", "rays.roots", "optical_depth", "range_m", "tilt")
    saved = slice(0)
    constant = (2,)

    def __init__(self, kernel: Pass, rays: RayGrid, depth: float | None) -> None:
        super().__init__(kernel)
        self.rays, self.depth = rays, depth

    def forward(self, inputs: Tensors) -> tuple[Tensor, ...]:
        centers, roots, optical_depth, *_ = inputs
        assert centers is not None
        assert roots is not None
        assert optical_depth is not None
        self.problem = new_problem(*optical_depth.shape, rays=self.rays)
        lit_area = torch.empty_like(optical_depth)
        footprints = structs.Projection(*map(pointer, inputs))
        fault, index = self.kernel.forward("attenuate", self.problem, footprints, lit_area.data_ptr())
        if fault == "lattice":
            reach, width = centers[index].abs().max(), deviations(roots[index]).max()
            raise SarsplatError(_too_many_rays(index, self.rays, float(reach), float(width)))
        _accept_footprints(self.names, inputs, fault, index)
        return lit_area, *_traced(self.kernel, self.problem, self.depth, False, lit_area)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        like = next(grad for grad in grads if grad is not None)
        results = [_by_view(like, self.problem, width) for width in (2, 3, None)]
        gradients = structs.Projection(*map(pointer, results))
        self.kernel.backward("attenuate", self.problem, pointer(grads[0]), pointer(grads[1]), gradients)
        return (*results, None, None)


class _Splat(Operation):
    """Footprints and cross-sections to images; of channels with `turns` per metre of elevation, with their slopes."""

    names = ("footprints.centers", "footprints.roots", "cross_sections", "waves.slopes")
    saved = slice(2, 4)

    def __init__(self, kernel: Pass, grid: ImageGrid, peak: bool, turns: Float[Tensor, "v c"] | None) -> None:
        super().__init__(kernel)
        self.grid, self.peak, self.turns = grid, peak, turns

    def forward(self, inputs: Tensors) -> tuple[Tensor, ...]:
        centers, roots, cross_sections, slopes = inputs
        assert cross_sections is not None
        views, n, channels = cross_sections.shape
        self.problem = new_problem(views, n, grid=self.grid, peak=self.peak)
        images = cross_sections.new_empty(views, channels, self.grid.rows, self.grid.columns)
        footprints = structs.Projection(pixel_centers=pointer(centers), pixel_roots=pointer(roots))
        splatted = self._channels(cross_sections, slopes)
        fault = self.kernel.forward("splat", self.problem, footprints, splatted, images.data_ptr())
        _accept_footprints(self.names, inputs, *fault)
        return (images,)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        (cross_sections, slopes), (d_images,) = saved, grads
        assert d_images is not None
        centers, roots, elevation = (_by_view(cross_sections, self.problem, width) for width in (2, 3, 3))
        d_cross_sections = torch.empty_like(cross_sections)
        self.kernel.backward(
            "splat",
            self.problem,
            self._channels(cross_sections, slopes),
            d_images.data_ptr(),
            structs.Projection(pixel_centers=pointer(centers), pixel_roots=pointer(roots)),
            d_cross_sections.data_ptr(),
            None if slopes is None else elevation.data_ptr(),
        )
        if slopes is None:
            return centers, roots, d_cross_sections, None
        # the elevation is slopes · (pixel − centre), and `elevation` its gradient: the sum, and that with displacements
        return centers - elevation[..., :1] * slopes, roots, d_cross_sections, elevation[..., 1:]

    def _channels(self, cross_sections: Tensor, slopes: Tensor | None) -> Any:
        return structs.Channels(cross_sections.shape[2], *map(pointer, (cross_sections, self.turns, slopes)))


# ---- what they share -------------------------------------------------------------------------------------------------
def _shift(gaussians: Gaussians, views: Sequence[View], shift: Tensor | None) -> Tensor:
    return gaussians.means.new_zeros(len(views), 2) if shift is None else shift


def _by_view(like: Tensor, problem: Any, width: int | None) -> Tensor:
    """A new tensor [V, N] or [V, N, width]."""
    shape = problem.views, problem.gaussians
    return like.new_empty(shape if width is None else (*shape, width))


def _traced(kernel: Pass, problem: Any, depth: float | None, ends: bool, like: Tensor) -> tuple[Tensor, Tensor]:
    """T_end of the rays of all views, one after the other, and first returns; of none that are not asked for."""
    asked = ends or depth is not None
    sizes = [kernel.lattice(v).rows * kernel.lattice(v).columns for v in range(problem.views)] if asked else []
    transmittance = like.new_empty(sum(sizes))
    first_return = like.new_empty(0 if depth is None else sum(sizes))
    at = 0
    for v, size in enumerate(sizes):
        returns = None if depth is None else first_return[at:].data_ptr()
        kernel.trace(problem, v, depth or 0.0, transmittance[at:].data_ptr(), returns)
        at += size
    return transmittance, first_return


def _ray_ends(step: _Render | _Attenuate, transmittance: Tensor) -> RayEnds:
    """T_end of the rays of all views, and where they are."""
    lattices, (dx, dy) = [step.kernel.lattice(view) for view in range(step.problem.views)], step.rays.spacing_m
    sizes = [(lattice.rows, lattice.columns) for lattice in lattices]
    return RayEnds(transmittance, sizes, [((lattice.k0x + 0.5) * dx, (lattice.k0y + 0.5) * dy) for lattice in lattices])


def _ray_maps(step: _Render | _Attenuate, traced: Sequence[Tensor]) -> tuple[RayMap, ...] | None:
    """What was traced, cut into the views' lattices; None if nothing was."""
    if step.depth is None:
        return None
    ends, maps = _ray_ends(step, traced[0]), []
    cut = [values.split([math.prod(size) for size in ends.sizes]) for values in traced]
    for left, first, size, origin in zip(*cut, ends.sizes, ends.origins, strict=True):
        maps.append(RayMap(left.view(size), first.view(size), origin))
    return tuple(maps)


def _too_many_rays(view: int, rays: RayGrid, reach_m: float, width_m: float) -> str:
    """The sentence for a lattice that would be too large."""
    return (
        f"view {view} would need too many rays at a spacing of {rays.spacing_m} m: the Gaussians reach {reach_m:.4g} m "
        f"from the scene centre and are up to {width_m:.4g} m wide; remove distant or wide ones, or use coarser rays"
    )


def _accept_footprints(names: Sequence[str], inputs: Tensors, fault: str, index: int) -> None:
    """Raise what a step rejected, if anything."""
    for name, tensor in zip(names, inputs, strict=True):
        if fault and name.rpartition(".")[2] == fault:
            assert tensor is not None
            raise SarsplatError(complaint_by_view(name, tensor, index))
