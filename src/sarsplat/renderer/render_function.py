"""A whole rendering as one differentiable function: one call of an engine each way, and what is wrong by name."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, Harmonics
from sarsplat.gaussians.harmonics import harmonic_basis
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.renderer import structs
from sarsplat.renderer.bounds import Bounds
from sarsplat.renderer.checks import (
    FARTHEST,
    FLATTEST,
    MAX_SCALE,
    STEEPEST,
    STRONGEST,
    check_values,
    complaint,
    complaint_by_view,
)
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE
from sarsplat.renderer.cpu import FAULTS
from sarsplat.renderer.once import differentiable_once
from sarsplat.renderer.passes import Pass
from sarsplat.renderer.rendering import RayMap, Rendering

ARRAYS = ("means", "quaternions", "scales", "kappa", "harmonics", "amplitudes", "shift")
"""Inputs by their names in a problem."""


@dataclass(frozen=True)
class _Setting:
    """Everything about a call that is not differentiable."""

    views: tuple[View, ...]
    grid: ImageGrid
    rays: RayGrid
    p_min: float  # of harmonics
    peak: bool
    first_return_depth: float | None
    new_pass: Callable[[], Pass]
    planes: Float[Tensor, "v n 4"] | None


def render_with(
    new_pass: Callable[[], Pass],
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    amplitudes: Float[Tensor, "v n c"] | None,
    shift: Float[Tensor, "v 2"] | None,
    gain: Float[Tensor, " v"] | None,
    imaging_weight: str,
    first_return_depth: float | None,
    plane_gradients: bool,
    bounds: Bounds | None = None,
) -> Rendering:
    """`sarsplat.render` on an engine's passes; arguments are documented there. With bounds, no value is looked at."""
    if gain is not None and bounds is not None:
        bounds.watch(gain)
    else:
        check_values({"gain": gain})  # the rest is checked on the way in
    planes = gaussians.means.new_zeros(len(views), len(gaussians), 4) if plane_gradients else None
    law, harmonics = gaussians.scattering, None
    if amplitudes is None and isinstance(law, Harmonics):
        harmonics = law.parameters  # kernels evaluate these themselves
    elif amplitudes is None:
        amplitudes = gaussians.amplitudes(directions_to(views, gaussians.means))
    setting = _Setting(
        tuple(views), grid, rays, law.p_min, imaging_weight == "peak", first_return_depth, new_pass, planes
    )
    shift = gaussians.means.new_zeros(len(views), 2) if shift is None else shift
    images, cross_sections, lit_area, transmittance, first_return, lattices = _Render.apply(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        gaussians.optical_depth,
        harmonics,
        amplitudes,
        shift,
        setting,
    )
    if gain is not None:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        images = images * gain[:, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
    ray_maps = ray_maps_of(transmittance, first_return, lattices, rays) if first_return_depth is not None else None
    return Rendering(images, cross_sections, lit_area, ray_maps, planes)


def ray_maps_of(
    transmittance: Float[Tensor, " all_rays"],
    first_return: Float[Tensor, " all_rays"],
    lattices: list[tuple[int, int, int, int]],
    rays: RayGrid,
) -> tuple[RayMap, ...]:
    maps, at = [], 0
    for k0x, k0y, rows, columns in lattices:
        part = slice(at, at + rows * columns)
        origin = ((k0x + 0.5) * rays.spacing_m[0], (k0y + 0.5) * rays.spacing_m[1])
        maps.append(RayMap(transmittance[part].view(rows, columns), first_return[part].view(rows, columns), origin))
        at = part.stop
    return tuple(maps)


class _Render(torch.autograd.Function):
    """One call each way for all views."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        optical_depth: Tensor,
        harmonics: Tensor | None,
        amplitudes: Float[Tensor, "v n c"] | None,
        shift: Tensor,
        setting: _Setting,
    ) -> tuple[Any, ...]:
        inputs = [
            t if t is None else t.contiguous()
            for t in (means, quaternions, scales, optical_depth, harmonics, amplitudes)
        ]
        inputs.append(shift.contiguous())
        problem, constants = problem_of(inputs, setting.views, setting.grid, setting.rays, setting.p_min, setting.peak)
        views, n, channels, grid = len(setting.views), means.shape[0], problem.channels, setting.grid
        images = means.new_empty(views, channels, grid.rows, grid.columns)  # never torch's default dtype or device
        cross_sections, lit_area = means.new_empty(views, n, channels), means.new_empty(views, n)
        kernel = setting.new_pass()
        outputs = structs.Outputs(images.data_ptr(), cross_sections.data_ptr(), lit_area.data_ptr())
        fault, index = kernel.forward(problem, outputs)
        if fault:
            raise SarsplatError(explain(fault, index, inputs, setting.rays))
        transmittance = first_return = means.new_empty(0)
        lattices: list[tuple[int, int, int, int]] = []
        if setting.first_return_depth is not None:
            transmittance, first_return, lattices = trace_all(
                kernel, partial(kernel.trace, problem), setting.first_return_depth, len(setting.views), means.device
            )
        ctx.kernel, ctx.problem, ctx.constants, ctx.setting = kernel, problem, constants, setting
        ctx.names, ctx.shapes = ARRAYS, [t if t is None else t.shape for t in inputs]
        ctx.one_at_a_time = threading.Lock()  # the kernel lets go of Python's, and has one set of scratch memory
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(lit_area, first_return)
        ctx.set_materialize_grads(False)
        return images, cross_sections, lit_area, transmittance, first_return, lattices

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        d_images, d_cross_sections, _, d_transmittance, *_ = grads
        inputs = saved_inputs(ctx)
        setting: _Setting = ctx.setting
        if d_images is None:
            d_images = inputs[0].new_zeros(
                len(setting.views), ctx.problem.channels, setting.grid.rows, setting.grid.columns
            )
        seeds = [t if t is None else t.contiguous() for t in (d_images, d_cross_sections, d_transmittance)]
        results = [None if t is None else torch.empty_like(t) for t in inputs]
        gradients = structs.Gradients(*(pointer(t) for t in (*seeds, *results, setting.planes)))
        with ctx.one_at_a_time:
            point_at(ctx.problem, inputs)
            ctx.kernel.backward(ctx.problem, gradients)
        return (*results, None)


def saved_inputs(ctx: Any) -> list[Any]:
    """The tensors that a forward pass saved, of the shapes they had.

    Also the check that nobody changed them in place; they need not lie where they lay in the forward pass.

    Raises
    ------
    SarsplatError
        If one has another shape now.
    """
    saved = ctx.saved_tensors  # asked for once: what checkpointing recomputes, it hands out once
    inputs = [t if t is None else t.contiguous() for t in saved]
    for name, tensor, shape in zip(ctx.names, inputs, ctx.shapes, strict=True):
        if tensor is not None and tensor.shape != shape:
            raise SarsplatError(
                f"{name} had shape {tuple(shape)} when rendered and now have shape {tuple(tensor.shape)};  do not "
                "replace the data of tensors between rendering and backward"
            )
    return inputs


def pointer(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def point_at(problem: ctypes.Structure, inputs: Sequence[Tensor | None]) -> None:
    """Let a problem read these, in the order of `ARRAYS`."""
    for name, tensor in zip(ARRAYS, inputs, strict=True):
        setattr(problem, name, pointer(tensor))


def directions_to(views: Sequence[View], like: Tensor) -> Float[Tensor, "v 3"]:
    """Unit vectors towards the radar, of the dtype and on the device of `like`."""
    return torch.stack([_direction(view, like.dtype, like.device) for view in views])


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@lru_cache(maxsize=4096)
def _direction(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """The unit vector towards the radar."""
    return torch.from_numpy(view.direction).to(device, dtype)


@lru_cache(maxsize=4096)
def _frame_and_basis(view: View, degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Radar frame [3, 3] and harmonics towards the radar, float32."""
    frame = torch.from_numpy(radar_frame(view))
    basis = harmonic_basis(-frame[2], degree)
    return frame.float().to(device), basis.float().to(device)


def problem_of(
    inputs: Sequence[Tensor | None],
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    p_min: float,
    peak: bool = False,
) -> tuple[ctypes.Structure, tuple[Tensor, ...]]:
    """The kernel's view of a call, and the tensors it points at that must outlive it."""
    means, _, _, _, harmonics, amplitudes, _ = inputs
    assert means is not None
    degree = 0 if harmonics is None else math.isqrt(harmonics.shape[1]) - 1
    by_view = zip(*(_frame_and_basis(view, degree, means.device) for view in views))
    frames, basis = (torch.stack(part) for part in by_view)
    problem = new_problem(len(views), len(means), grid=grid, rays=rays, peak=peak)
    problem.coefficients = 0 if harmonics is None else harmonics.shape[1]
    problem.channels = 1 if amplitudes is None else amplitudes.shape[2]
    problem.frames, problem.basis, problem.p_min = pointer(frames), pointer(basis), p_min
    point_at(problem, inputs)
    return problem, (frames, basis)


def new_problem(
    views: int, gaussians: int, *, grid: ImageGrid | None = None, rays: RayGrid | None = None, peak: bool = False
) -> ctypes.Structure:
    """The kernel's view of a call, without its arrays; a step alone needs the grid of its plane only."""
    problem = structs.Problem(
        peak,
        views,
        gaussians,
        channels=1,
        cell_widening=CELL_WIDENING,
        min_ray_depth=MIN_RAY_DEPTH,
        min_transmittance=MIN_TRANSMITTANCE,
        image_cut=IMAGE_CUT,
        min_scale=MIN_SCALE * (1 - 1e-6),
        max_scale=MAX_SCALE,
        max_depth=MAX_OPTICAL_DEPTH * (1 + 1e-6),
        farthest=FARTHEST,
        strongest=STRONGEST,
        flattest=FLATTEST,
        steepest=STEEPEST,
    )
    if grid is not None:
        problem.rows, problem.columns = grid.rows, grid.columns
        problem.pixel, problem.center = grid.spacing_m, grid.center_m
        problem.response_var = grid.response_variance_m2
    if rays is not None:
        problem.ray = rays.spacing_m
    return problem


def trace_all(
    kernel: Pass, trace: Callable[[int, float, int, int], None], depth: float, views: int, device: torch.device
) -> tuple[Float[Tensor, " all_rays"], Float[Tensor, " all_rays"], list[tuple[int, int, int, int]]]:
    """T_end and first returns of the rays of all views, and (k0x, k0y, rows, columns) of their lattices."""
    lattices = [kernel.lattice(v) for v in range(views)]
    total = sum(lattice.rows * lattice.columns for lattice in lattices)
    transmittance, first_return = torch.empty(2, total, dtype=torch.float32, device=device)
    at = 0
    for v, lattice in enumerate(lattices):
        trace(v, depth, transmittance[at:].data_ptr(), first_return[at:].data_ptr())
        at += lattice.rows * lattice.columns
    return transmittance, first_return, [(la.k0x, la.k0y, la.rows, la.columns) for la in lattices]


def too_many_rays(view: int, rays: RayGrid, reach_m: float, width_m: float) -> str:
    """The sentence for a lattice that would be too large."""
    return (
        f"view {view} would need too many rays at a spacing of {rays.spacing_m} m: the Gaussians reach {reach_m:.4g} m "
        f"from the scene centre and are up to {width_m:.4g} m wide; remove distant or wide ones, or use coarser rays"
    )


def explain(fault: str, index: int, inputs: Sequence[Tensor | None], rays: RayGrid) -> str:
    """The sentence for what a pass over the arrays of `ARRAYS` rejected."""
    if fault == "lattice":
        means, scales = inputs[0], inputs[2]
        assert means is not None
        assert scales is not None
        return too_many_rays(index, rays, float(means.abs().max()), float(scales.max()))
    tensor = inputs[FAULTS.index(fault) - 1]
    assert tensor is not None
    if fault == "amplitudes":
        return complaint_by_view(fault, tensor, index)
    return complaint(fault, tensor, index)
