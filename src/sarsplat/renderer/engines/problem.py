"""A call as the kernels want it: the C structure of its arrays, grids and limits."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE
from sarsplat.gaussians.harmonics import harmonic_basis
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import FARTHEST, FLATTEST, MAX_SCALE, STEEPEST, STRONGEST
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.chosen_views import by_view
from sarsplat.renderer.engines.on_device import kept_on_device

ARRAYS = ("means", "quaternions", "scales", "kappa", "harmonics", "amplitudes", "shift")
"""Inputs by their names in a problem."""


def pointer(tensor: Tensor | None) -> int | None:
    """Where a tensor's values lie."""
    return None if tensor is None else tensor.data_ptr()


def point_at(problem: ctypes.Structure, inputs: Sequence[Tensor | None]) -> None:
    """Let a problem read these, in the order of `ARRAYS`."""
    for name, tensor in zip(ARRAYS, inputs, strict=True):
        setattr(problem, name, pointer(tensor))


def directions_to(views: Sequence[View], like: Tensor) -> Float[Tensor, "v 3"]:
    """Unit vectors towards the radar, of the dtype and on the device of `like`."""
    return by_view(_direction, views, like.dtype, like.device)


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@kept_on_device(maxsize=4096)
def _direction(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """The unit vector towards the radar."""
    return torch.from_numpy(view.look.facing).to(device, dtype)


@kept_on_device(maxsize=4096)
def _frame(view: View, device: torch.device) -> Float[Tensor, "3 3"]:
    return torch.from_numpy(view.look.frame).float().to(device)


@kept_on_device(maxsize=4096)
def flat_frame(view: View, device: torch.device) -> Float[Tensor, "3 3"]:
    """A frame in which a place has the azimuth and the range of its foot at z = 0, and between them its height."""
    along, away = view.look.gradients * (1.0, 1.0, 0.0)
    return torch.from_numpy(np.stack([along, np.cross(along, away), away])).float().to(device)


@kept_on_device(maxsize=4096)
def mirrored_frame(view: View, device: torch.device) -> Float[Tensor, "3 3"]:
    """The frame in which a scene has the coordinates that its image in the plane z = 0 has in the view's."""
    return torch.from_numpy(view.look.frame * (1.0, 1.0, -1.0)).float().to(device)


@kept_on_device(maxsize=4096)
def mirror_offset(view: View, height_m: float, device: torch.device) -> Float[Tensor, " 2"]:
    """By how much its image in the plane z = height lies elsewhere on the computation plane, m."""
    return torch.from_numpy(view.look.frame[:2, 2] * (2 * height_m)).float().to(device)


@kept_on_device(maxsize=4096)
def foot_shift(view: View, height_m: float, device: torch.device) -> Float[Tensor, " 2"]:
    """By how much a foot at this height is imaged elsewhere than the one at z = 0, m."""
    return torch.from_numpy(view.look.gradients[:, 2] * height_m).float().to(device)


@kept_on_device(maxsize=4096)
def level_direction(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """The unit vector in the middle between that towards the radar and its mirror image: level."""
    return torch.from_numpy(_level(view)).to(device, dtype)


@kept_on_device(maxsize=4096)
def level_basis(view: View, degree: int, device: torch.device) -> Float[Tensor, " k"]:
    """Harmonics along that."""
    return harmonic_basis(torch.from_numpy(_level(view)), degree).float().to(device)


def _level(view: View) -> Float[np.ndarray, " 3"]:
    flat = view.look.facing * (1.0, 1.0, 0.0)
    return flat / np.linalg.norm(flat)


@kept_on_device(maxsize=4096)
def _basis(view: View, degree: int, device: torch.device) -> Float[Tensor, " k"]:
    """Harmonics towards the radar."""
    return harmonic_basis(torch.from_numpy(view.look.facing), degree).float().to(device)


def problem_of(
    inputs: Sequence[Tensor | None],
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    p_min: float,
    peak: bool = False,
) -> tuple[ctypes.Structure, tuple[Tensor | None, ...]]:
    """The kernel's view of a call, and the tensors it points at that must outlive it."""
    means, _, _, _, harmonics, amplitudes, _ = inputs
    assert means is not None
    degree = 0 if harmonics is None else math.isqrt(harmonics.shape[1]) - 1
    frames = by_view(_frame, views, means.device)
    basis = None if harmonics is None else by_view(_basis, views, degree, means.device)
    problem = new_problem(len(views), len(means), grid=grid, rays=rays, peak=peak)
    problem.coefficients = 0 if harmonics is None else harmonics.shape[1]
    problem.channels = 1 if amplitudes is None else amplitudes.shape[2]
    problem.frames, problem.basis, problem.p_min = pointer(frames), pointer(basis), p_min
    point_at(problem, inputs)
    return problem, (frames, basis)


_LIMITS = api.problem(
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
"""What is the same in every call."""


def new_problem(
    views: int, gaussians: int, *, grid: ImageGrid | None = None, rays: RayGrid | None = None, peak: bool = False
) -> ctypes.Structure:
    """The kernel's view of a call, without its arrays; a step alone needs the grid of its plane only."""
    problem = api.problem.from_buffer_copy(_LIMITS)
    problem.peak, problem.views, problem.gaussians = peak, views, gaussians
    if grid is not None:
        problem.rows, problem.columns = grid.rows, grid.columns
        problem.pixel, problem.center = grid.spacing_m, grid.center_m
        problem.response_var = grid.response_variance_m2
    if rays is not None:
        problem.ray = rays.spacing_m
    return problem
