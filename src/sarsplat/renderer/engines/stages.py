"""Renderings and their steps as engine calls on plain tensors, with messages about rejected inputs."""

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import complaint
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.cpu import INPUTS
from sarsplat.renderer.engines.on_device import by_view
from sarsplat.renderer.engines.operation import Call, Tensors
from sarsplat.renderer.engines.passes import Pass
from sarsplat.renderer.engines.problem import (
    ARRAYS,
    basis_of,
    flat_frame,
    frame_of,
    mirror_offset,
    mirrored_frame,
    new_problem,
    point_at,
    pointer,
)
from sarsplat.renderer.rendering import deviations

_WIDTHS = (2, 3, None, None, 2, 2, 3, None)  # of the tensors [V, N, …] of a projection, as in csrc/api.h


class Stage(Call):
    """Call whose backward pass uses the state of its forward pass."""

    rays: RayGrid

    of_pairs: ClassVar[bool] = True
    """True if inputs have a row for each view and Gaussian."""

    def __init__(self, kernel: Pass) -> None:
        self.kernel = kernel

    def extent(self, inputs: Sequence[Any], view: int) -> tuple[Tensor, Tensor]:
        """Return the distance of the farthest Gaussian from the scene centre, and the width of the widest, m."""
        raise NotImplementedError

    def accept(self, inputs: Sequence[Any], fault: str, index: int) -> None:
        """Raise if the kernel rejected an input."""
        if fault == "lattice":
            reach_m, width_m = map(float, self.extent(inputs, index))
            raise SarsplatError(
                f"view {index} would need too many rays at a spacing of {self.rays.spacing_m} m: the Gaussians reach "
                f"{reach_m:.4g} m from the scene centre and are up to {width_m:.4g} m wide; remove distant or wide "
                "ones, or use coarser rays"
            )
        for name, tensor in zip(self.names, inputs, strict=True):
            if fault and name.rpartition(".")[2] == fault:
                raise SarsplatError(complaint(name, tensor, index, by_view=self.of_pairs or fault == "amplitudes"))


class _OfGaussians(Stage):
    """Stage whose inputs are the arrays of a problem."""

    names: ClassVar[tuple[str, ...]] = INPUTS
    of_pairs = False
    frame: ClassVar[Callable[..., Tensor]] = staticmethod(frame_of)
    """Frame of a view in which Gaussians are projected."""
    level: ClassVar[bool] = False
    """True if harmonics are evaluated along `level_direction`."""
    peak = False

    def __init__(self, kernel: Pass, views: Sequence[View], grid: ImageGrid, rays: RayGrid, p_min: float) -> None:
        super().__init__(kernel)
        self.views, self.grid, self.rays, self.p_min = views, grid, rays, p_min

    def pose(self, arrays: Sequence[Any]) -> Any:
        """Return the problem of these arrays, those of `ARRAYS`."""
        means, _, _, _, harmonics, amplitudes, _ = arrays
        problem = new_problem(len(self.views), len(means), grid=self.grid, rays=self.rays, peak=self.peak)
        frames, basis = by_view(self.frame, self.views, means.dtype, means.device), None
        if harmonics is not None:
            problem.coefficients = harmonics.shape[1]
            basis = by_view(basis_of, self.views, math.isqrt(harmonics.shape[1]) - 1, self.level, means.device)
        if amplitudes is not None:
            problem.channels = amplitudes.shape[2]
        problem.frames, problem.basis, problem.p_min = pointer(frames), pointer(basis), self.p_min
        point_at(problem, arrays)
        self.problem, self.constants = problem, (frames, basis)  # constants live as long as the problem
        return problem

    def new_gradients(self, saved: list[Any]) -> list[Tensor | None]:
        """Make tensors for gradients of the given inputs; of the shift, which takes an extra kernel, only if needed."""
        *others, shift = [None if t is None else torch.empty_like(t) for t in saved]
        return [*others, shift if self.needed[len(ARRAYS) - 1] else None]

    def extent(self, inputs: Sequence[Any], view: int) -> tuple[Tensor, Tensor]:
        means, _, scales, *_ = inputs
        return means.abs().max(), scales.max()


class Render(_OfGaussians):
    """Rendering of all views in one call each way: images, cross-sections, lit areas, and traced rays."""

    depth: float | None = None
    """Two-way optical depth of first returns; None if they are not requested."""
    ends = False
    """True if T_end is requested."""
    in_sight: Float[Tensor, "v n"] | None = None
    planes: Float[Tensor, "v n 4"] | None = None
    """Filled with dL/d(mu_C, mu_I) in the backward pass."""
    constant = (4,)

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        means, problem = inputs[0], self.pose(inputs)
        problem.in_sight = pointer(self.in_sight)
        views, n, channels = problem.views, problem.gaussians, problem.channels
        # never torch's default dtype or device
        images = means.new_empty(views, channels, self.grid.rows, self.grid.columns)
        cross_sections, lit_area = means.new_empty(views, n, channels), means.new_empty(views, n)
        outputs = api.outputs(*map(pointer, (images, cross_sections, lit_area)))
        self.accept(inputs, *self.kernel.forward("render", problem, outputs))
        return images, cross_sections, lit_area, *_traced(self.kernel, problem, self.depth, self.ends, lit_area)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        d_images, d_cross_sections, d_lit_area, d_transmittance, _ = grads
        if d_images is None:
            shape = self.problem.views, self.problem.channels, self.grid.rows, self.grid.columns
            d_images = saved[0].new_zeros(shape)
        results = self.new_gradients(saved)
        seeds = d_images, d_cross_sections, d_transmittance, d_lit_area
        gradients = api.gradients(*map(pointer, (*seeds, *results, self.planes)))
        point_at(self.problem, saved)
        self.kernel.backward("render", self.problem, gradients)
        return results


class Project(_OfGaussians):
    """Projection; the last of its tensors is γ⁰ of harmonics."""

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        problem = self.pose(inputs)
        outputs = tuple(_by_view(inputs[0], problem, width) for width in _WIDTHS)
        self.accept(inputs, *self.kernel.forward("project", problem, api.projection(*map(pointer, outputs))))
        self.constant = (3, 4) if problem.coefficients else (3, 4, 7)
        return outputs

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        seeds = [
            None if k in (3, 4) else _by_view(saved[0], self.problem, width).zero_() if grad is None else grad
            for k, (grad, width) in enumerate(zip(grads, _WIDTHS, strict=True))  # neither range nor tilt
        ]
        results = self.new_gradients(saved)
        gradients = api.gradients(**dict(zip(ARRAYS, map(pointer, results), strict=True)))
        point_at(self.problem, saved)
        self.kernel.backward("project", self.problem, api.projection(*map(pointer, seeds)), gradients)
        return results


class PressedFlat(Project):
    """Projection of Gaussians pressed flat onto z = 0; only footprints on the imaging plane are valid."""

    frame = staticmethod(flat_frame)


class Bounce(_OfGaussians):
    """Images of the bounce off a mirror on the ground, one channel, of all views in one call each way."""

    names = (*INPUTS, "transmittance", "lit_area")
    frame = staticmethod(mirrored_frame)
    level = True

    lattices: Sequence[Any]
    """Lattices of the rays of each view."""
    height_m: float
    factor: float
    """Factor on √(lit area · lit area by way of the mirror) times amplitudes."""

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        means, problem = inputs[0], self.pose(inputs[: len(ARRAYS)])
        self.feet = by_view(flat_frame, self.views, means.dtype, means.device)
        self.offset = by_view(mirror_offset, self.views, self.height_m, means.device)
        images = means.new_empty(problem.views, self.grid.rows, self.grid.columns)
        self.accept(inputs, *self.kernel.forward("bounce", problem, self._bounce(inputs), images.data_ptr()))
        return (images,)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        arrays, (transmittance, lit_area) = saved[: len(ARRAYS)], saved[len(ARRAYS) :]
        results = self.new_gradients(arrays)
        gradients = api.gradients(images=pointer(grads[0]), **dict(zip(ARRAYS, map(pointer, results), strict=True)))
        ends, lit = torch.zeros_like(transmittance), torch.empty_like(lit_area)
        point_at(self.problem, arrays)
        addresses = ends.data_ptr(), lit.data_ptr()
        self.kernel.backward("bounce", self.problem, self._bounce(saved), gradients, *addresses)
        return [*results, ends, lit]

    def _bounce(self, inputs: Sequence[Any]) -> Any:
        """Make the structure of the bounce's arrays."""
        transmittance, lit_area = inputs[len(ARRAYS) :]
        return api.bounce(
            image_frames=pointer(self.feet),
            offset=pointer(self.offset),
            transmittance=pointer(transmittance),
            lattices=(api.lattice * len(self.lattices))(*self.lattices),
            lit_area=pointer(lit_area),
            factor=self.factor,
        )


class Attenuate(Stage):
    """Attenuation: footprints to lit areas and traced rays."""

    names = ("rays.centers", "rays.roots", "optical_depth", "range_m", "tilt")
    saved = slice(0)
    constant = (2,)

    def __init__(self, kernel: Pass, rays: RayGrid, depth: float | None) -> None:
        super().__init__(kernel)
        self.rays, self.depth = rays, depth

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        optical_depth = inputs[2]
        self.problem = new_problem(*optical_depth.shape, rays=self.rays)
        lit_area = torch.empty_like(optical_depth)
        footprints = api.projection(*map(pointer, inputs))
        self.accept(inputs, *self.kernel.forward("attenuate", self.problem, footprints, lit_area.data_ptr()))
        return lit_area, *_traced(self.kernel, self.problem, self.depth, False, lit_area)

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        like = next(grad for grad in grads if grad is not None)
        results = [_by_view(like, self.problem, width) for width in (2, 3, None)]
        gradients = api.projection(*map(pointer, results))
        self.kernel.backward("attenuate", self.problem, pointer(grads[0]), pointer(grads[1]), gradients)
        return (*results, None, None)

    def extent(self, inputs: Sequence[Any], view: int) -> tuple[Tensor, Tensor]:
        centers, roots, *_ = inputs
        return centers[view].abs().max(), deviations(roots[view]).max()


class Splat(Stage):
    """Splatting: footprints and cross-sections to images; with waves of `turns` per metre of elevation if given."""

    names = ("footprints.centers", "footprints.roots", "cross_sections", "waves.slopes")
    saved = slice(2, 4)

    def __init__(self, kernel: Pass, grid: ImageGrid, peak: bool, turns: Float[Tensor, "v c"] | None) -> None:
        super().__init__(kernel)
        self.grid, self.peak, self.turns = grid, peak, turns

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        centers, roots, cross_sections, slopes = inputs
        views, n, channels = cross_sections.shape
        self.problem = new_problem(views, n, grid=self.grid, peak=self.peak)
        images = cross_sections.new_empty(views, channels, self.grid.rows, self.grid.columns)
        footprints = api.projection(pixel_centers=pointer(centers), pixel_roots=pointer(roots))
        splatted = self._channels(cross_sections, slopes)
        self.accept(inputs, *self.kernel.forward("splat", self.problem, footprints, splatted, images.data_ptr()))
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
            api.projection(pixel_centers=pointer(centers), pixel_roots=pointer(roots)),
            d_cross_sections.data_ptr(),
            None if slopes is None else elevation.data_ptr(),
        )
        if slopes is None:
            return centers, roots, d_cross_sections, None
        # the elevation is slopes · (pixel − centre), and `elevation` its gradient: the sum, and that with displacements
        return centers - elevation[..., :1] * slopes, roots, d_cross_sections, elevation[..., 1:]

    def _channels(self, cross_sections: Tensor, slopes: Tensor | None) -> Any:
        return api.channels(cross_sections.shape[2], *map(pointer, (cross_sections, self.turns, slopes)))


def _by_view(like: Tensor, problem: Any, width: int | None) -> Tensor:
    """Make a tensor [V, N] or [V, N, width]."""
    shape = problem.views, problem.gaussians
    return like.new_empty(shape if width is None else (*shape, width))


def _traced(kernel: Pass, problem: Any, depth: float | None, ends: bool, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return T_end and first returns of the rays of all views, one after the other; empty if not requested."""
    requested = ends or depth is not None
    count = kernel.ray_count(problem.views) if requested else 0
    transmittance, first_return = like.new_empty(count), like.new_empty(0 if depth is None else count)
    if requested:
        kernel.trace(problem, depth or 0.0, transmittance.data_ptr(), pointer(None if depth is None else first_return))
    return transmittance, first_return
