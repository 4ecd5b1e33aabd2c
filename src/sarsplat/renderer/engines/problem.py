"""Problems: C structures of a call's arrays, grids and limits."""

import ctypes
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE
from sarsplat.gaussians.law_harmonics import harmonic_basis
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import FARTHEST, FLATTEST, MAX_SCALE, STEEPEST, STRONGEST
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.on_device import by_view, kept_on_device

ARRAYS = ("means", "quaternions", "scales", "kappa", "harmonics", "amplitudes", "shift")
"""Members of a problem for the inputs of a rendering."""


def pointer(tensor: Tensor | None) -> int | None:
    """Return the address of a tensor's values."""
    return None if tensor is None else tensor.data_ptr()


def point_at(problem: ctypes.Structure, inputs: Sequence[Tensor | None]) -> None:
    """Set the addresses of a problem's inputs, in the order of `ARRAYS`."""
    for name, tensor in zip(ARRAYS, inputs, strict=True):
        setattr(problem, name, pointer(tensor))


def directions_to(views: Sequence[View], like: Tensor) -> Float[Tensor, "v 3"]:
    """Return unit vectors towards the radar, of the dtype and on the device of `like`."""
    return by_view(_direction, views, like.dtype, like.device)


# A training renders the same few views again and again, which are sent to a GPU only once.
@kept_on_device(maxsize=4096)
def _direction(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """Return the unit vector towards the radar."""
    return torch.from_numpy(view.look.facing).to(device, dtype)


@kept_on_device(maxsize=4096)
def frame_of(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3"]:
    """Return the radar frame."""
    return torch.from_numpy(view.look.frame).to(device, dtype)


@kept_on_device(maxsize=4096)
def flat_frame(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3"]:
    """Return the frame (azimuth, height, range) in which a place has azimuth and range of its foot at z = 0."""
    along, away = view.look.gradients * (1.0, 1.0, 0.0)
    return torch.from_numpy(np.stack([along, np.cross(along, away), away])).to(device, dtype)


@kept_on_device(maxsize=4096)
def mirrored_frame(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3"]:
    """Return the frame in which a scene has the coordinates of its mirror image (z = 0) in the view's frame."""
    return torch.from_numpy(view.look.frame * (1.0, 1.0, -1.0)).to(device, dtype)


@kept_on_device(maxsize=4096)
def mirror_offset(view: View, height_m: float, device: torch.device) -> Float[Tensor, " 2"]:
    """Return the displacement of the mirror image on the computation plane for a mirror z = `height_m`, m."""
    return torch.from_numpy(view.look.frame[:2, 2] * (2 * height_m)).float().to(device)


@kept_on_device(maxsize=4096)
def foot_shift(view: View, height_m: float, device: torch.device) -> Float[Tensor, " 2"]:
    """Return the displacement in the image of a foot at z = `height_m`, relative to z = 0, m."""
    return torch.from_numpy(view.look.gradients[:, 2] * height_m).float().to(device)


@kept_on_device(maxsize=4096)
def level_direction(view: View, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """Return the level unit vector halfway between the direction to the radar and its mirror image."""
    return torch.from_numpy(_level(view)).to(device, dtype)


@kept_on_device(maxsize=4096)
def basis_of(view: View, degree: int, level: bool, device: torch.device) -> Float[Tensor, " k"]:
    """Return harmonics towards the radar, or along `level_direction`."""
    direction = torch.from_numpy(_level(view) if level else view.look.facing)
    return harmonic_basis(direction, degree).float().to(device)


def _level(view: View) -> Float[np.ndarray, " 3"]:
    flat = view.look.facing * (1.0, 1.0, 0.0)
    return flat / np.linalg.norm(flat)


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
"""Members that are equal in every call."""


def new_problem(
    views: int, gaussians: int, *, grid: ImageGrid | None = None, rays: RayGrid | None = None, peak: bool = False
) -> ctypes.Structure:
    """Return a problem without arrays; a single step needs only the grid of its plane."""
    problem = api.problem.from_buffer_copy(_LIMITS)
    problem.peak, problem.views, problem.gaussians = peak, views, gaussians
    if grid is not None:
        problem.rows, problem.columns = grid.rows, grid.columns
        problem.pixel, problem.center = grid.spacing_m, grid.center_m
        problem.response_var = grid.response_variance_m2
    if rays is not None:
        problem.ray = rays.spacing_m
    return problem
