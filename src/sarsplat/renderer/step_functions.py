"""The steps of a rendering on an engine, each a differentiable function: one call of a kernel each way."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import structs
from sarsplat.renderer.checks import complaint_by_view
from sarsplat.renderer.footprints import Attenuation, Footprints, Projection, deviations
from sarsplat.renderer.once import differentiable_once
from sarsplat.renderer.passes import Pass
from sarsplat.renderer.render_function import (
    ARRAYS,
    directions_to,
    explain,
    new_problem,
    point_at,
    pointer,
    problem_of,
    ray_maps_of,
    saved_inputs,
    too_many_rays,
    trace_all,
)

_WIDTHS = (2, 3, None, None, 2, 2, 3, None)  # of the tensors [V, N, …] of a projection, as in structs.Projection


def project_with(
    new_pass: Callable[[], Pass],
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Projection:
    """`sarsplat.project` on an engine's passes."""
    g, law = gaussians, gaussians.scattering
    shift = g.means.new_zeros(len(views), 2) if shift is None else shift
    harmonics = law.parameters if isinstance(law, Harmonics) else None  # kernels evaluate these themselves
    ray_centers, ray_roots, depth, range_m, tilt, pixel_centers, pixel_roots, gamma0 = _Project.apply(
        *(g.means, g.quaternions, g.scales, g.optical_depth, harmonics, shift),
        *(tuple(views), grid, rays, law.p_min, new_pass),
    )
    amplitudes = gamma0[..., None] if harmonics is not None else g.amplitudes(directions_to(views, g.means))
    return Projection(
        Footprints(ray_centers, ray_roots), depth, range_m, tilt, Footprints(pixel_centers, pixel_roots), amplitudes
    )


def attenuate_with(
    new_pass: Callable[[], Pass], projection: Projection, rays: RayGrid, *, first_return_depth: float | None
) -> Attenuation:
    """`sarsplat.attenuate` on an engine's passes."""
    p = projection
    lit_area, transmittance, first_return, lattices = _Attenuate.apply(
        p.rays.centers, p.rays.roots, p.optical_depth, p.range_m, p.tilt, rays, first_return_depth, new_pass
    )
    if first_return_depth is None:
        return Attenuation(lit_area)
    return Attenuation(lit_area, ray_maps_of(transmittance, first_return, lattices, rays))


def splat_with(
    new_pass: Callable[[], Pass],
    footprints: Footprints,
    cross_sections: Float[Tensor, "v n c"],
    grid: ImageGrid,
    *,
    imaging_weight: str,
) -> Float[Tensor, "v c {grid.rows} {grid.columns}"]:
    """`sarsplat.splat` on an engine's passes."""
    return _Splat.apply(footprints.centers, footprints.roots, cross_sections, grid, imaging_weight == "peak", new_pass)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        optical_depth: Tensor,
        harmonics: Tensor | None,
        shift: Tensor,
        views: tuple[View, ...],
        grid: ImageGrid,
        rays: RayGrid,
        p_min: float,
        new_pass: Callable[[], Pass],
    ) -> tuple[Tensor | None, ...]:
        inputs = [t if t is None else t.contiguous() for t in (means, quaternions, scales, optical_depth, harmonics)]
        inputs += [None, shift.contiguous()]  # no amplitudes
        problem, constants = problem_of(inputs, views, grid, rays, p_min)
        outputs = [_by_view(means, problem, width) for width in _WIDTHS]
        kernel = new_pass()
        fault, index = kernel.project(problem, structs.Projection(*map(pointer, outputs)))
        if fault:
            raise SarsplatError(explain(fault, index, inputs, rays))
        ctx.kernel, ctx.problem, ctx.constants = kernel, problem, constants
        ctx.names, ctx.shapes = ARRAYS, [t if t is None else t.shape for t in inputs]
        ctx.one_at_a_time = threading.Lock()  # the kernel lets go of Python's
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(outputs[3], outputs[4], *(outputs[7:] if harmonics is None else ()))
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = saved_inputs(ctx)
        seeds = [
            None
            if k in (3, 4)
            else _by_view(inputs[0], ctx.problem, width).zero_()
            if grad is None
            else grad.contiguous()
            for k, (grad, width) in enumerate(zip(grads, _WIDTHS, strict=True))  # neither range nor tilt
        ]
        results = [None if t is None else torch.empty_like(t) for t in inputs]
        gradients = structs.Gradients(**dict(zip(ARRAYS, map(pointer, results), strict=True)))
        with ctx.one_at_a_time:
            point_at(ctx.problem, inputs)
            ctx.kernel.project_backward(ctx.problem, structs.Projection(*map(pointer, seeds)), gradients)
        return (*results[:5], results[6], None, None, None, None, None)


class _Attenuate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        centers: Tensor,
        roots: Tensor,
        optical_depth: Tensor,
        range_m: Tensor,
        tilt: Tensor,
        rays: RayGrid,
        first_return_depth: float | None,
        new_pass: Callable[[], Pass],
    ) -> tuple[Any, ...]:
        inputs = [t.contiguous() for t in (centers, roots, optical_depth, range_m, tilt)]
        views, n = optical_depth.shape
        problem = new_problem(views, n, rays=rays)
        footprints = structs.Projection(*(pointer(t) for t in inputs))
        lit_area = inputs[2].new_empty(views, n)
        kernel = new_pass()
        fault, index = kernel.attenuate(problem, footprints, lit_area.data_ptr())
        if fault == "lattice":
            reach, width = centers.detach()[index].abs().max(), deviations(roots.detach()[index]).max()
            raise SarsplatError(too_many_rays(index, rays, float(reach), float(width)))
        if fault:
            names = ("rays.centers", "rays.roots", "optical_depth", "range_m", "tilt")
            found = {name.rpartition(".")[2]: (name, tensor) for name, tensor in zip(names, inputs, strict=True)}
            raise SarsplatError(complaint_by_view(*found[fault], index))
        transmittance = first_return = lit_area.new_empty(0)
        lattices: list[tuple[int, int, int, int]] = []
        if first_return_depth is not None:
            trace = partial(kernel.trace, problem)
            transmittance, first_return, lattices = trace_all(kernel, trace, first_return_depth, views, lit_area.device)
        ctx.kernel, ctx.problem = kernel, problem
        ctx.one_at_a_time = threading.Lock()
        ctx.mark_non_differentiable(first_return)
        ctx.set_materialize_grads(False)
        return lit_area, transmittance, first_return, lattices

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        like = next((grad for grad in grads if grad is not None), None)
        if like is None:
            return (None,) * 8
        seeds = [grad if grad is None else grad.contiguous() for grad in grads[:2]]
        centers, roots, depth = (_by_view(like, ctx.problem, width) for width in (2, 3, None))
        with ctx.one_at_a_time:
            ctx.kernel.attenuate_backward(
                ctx.problem, *map(pointer, seeds), structs.Projection(*map(pointer, (centers, roots, depth)))
            )
        return centers, roots, depth, None, None, None, None, None


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        centers: Tensor,
        roots: Tensor,
        cross_sections: Tensor,
        grid: ImageGrid,
        peak: bool,
        new_pass: Callable[[], Pass],
    ) -> Tensor:
        inputs = [t.contiguous() for t in (centers, roots, cross_sections)]
        views, n, channels = cross_sections.shape
        problem = new_problem(views, n, grid=grid, peak=peak)
        images = cross_sections.new_empty(views, channels, grid.rows, grid.columns)
        kernel = new_pass()
        fault, index = kernel.splat(
            problem,
            structs.Projection(pixel_centers=pointer(inputs[0]), pixel_roots=pointer(inputs[1])),
            structs.Channels(channels, pointer(inputs[2])),
            images.data_ptr(),
        )
        if fault:
            names = ("footprints.centers", "footprints.roots", "cross_sections")
            found = {name.rpartition(".")[2]: (name, tensor) for name, tensor in zip(names, inputs, strict=True)}
            raise SarsplatError(complaint_by_view(*found[fault], index))
        ctx.kernel, ctx.problem = kernel, problem
        ctx.names, ctx.shapes = ("cross_sections",), [cross_sections.shape]
        ctx.one_at_a_time = threading.Lock()
        ctx.save_for_backward(inputs[2])
        return images

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_images: Tensor) -> tuple[Tensor | None, ...]:
        (cross_sections,) = saved_inputs(ctx)
        views, n, channels = cross_sections.shape
        d_images, d_cross_sections = d_images.contiguous(), torch.empty_like(cross_sections)
        centers, roots = cross_sections.new_empty(views, n, 2), cross_sections.new_empty(views, n, 3)
        with ctx.one_at_a_time:
            ctx.kernel.splat_backward(
                ctx.problem,
                structs.Channels(channels, pointer(cross_sections)),
                d_images.data_ptr(),
                structs.Projection(pixel_centers=pointer(centers), pixel_roots=pointer(roots)),
                d_cross_sections.data_ptr(),
            )
        return centers, roots, d_cross_sections, None, None, None


def _by_view(like: Tensor, problem: Any, width: int | None) -> Tensor:
    """A new tensor [V, N] or [V, N, width]."""
    shape = problem.views, problem.gaussians
    return like.new_empty(shape if width is None else (*shape, width))
