"""Operations on a GPU: arrays and launches. To add one, write a function and list it in `OPERATIONS`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from ctypes import c_int32, c_int64, c_void_p
from dataclasses import dataclass, field

from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.bounds import TILE
from sarsplat.renderer.engines.cpu import LIMITS
from sarsplat.renderer.engines.cuda_arrays import THREADS, Arrays
from sarsplat.renderer.engines.cuda_ground import lit_ground, lit_terrain

_MOST_GROUPS, _WINDOW = 15, 11
"""Maximum parameters of a launch, as in csrc/cuda_training.cuh; SSIM's window, pixels, as in loss_math.h."""


def _adam(arrays: Arrays, step: ctypes.Structure) -> None:
    for first in range(0, step.count, _MOST_GROUPS):
        groups = step.groups[first : min(first + _MOST_GROUPS, step.count)]
        blocks = sum(-(-group.rows * group.columns // THREADS) for group in groups)
        together = (api.adam_group * _MOST_GROUPS)(*groups)
        arrays.launch("step_adam", blocks, together, step, c_int32(first), c_int32(len(groups)))


def _amplitude_loss(arrays: Arrays, loss: ctypes.Structure) -> None:
    of_pixels, of_windows = (
        loss.views * -(-(loss.rows - reach) // TILE) * -(-(loss.columns - reach) // TILE) for reach in (0, _WINDOW - 1)
    )
    sums, similar, slopes = c_void_p(arrays.new("sums", of_pixels).data_ptr()), c_void_p(), c_void_p()
    if loss.ssim_weight > 0:
        windows = (loss.rows - _WINDOW + 1) * (loss.columns - _WINDOW + 1)
        slopes = c_void_p(arrays.new("slopes", 3, loss.views, windows).data_ptr())
        similar = c_void_p(arrays.new("similar", of_windows).data_ptr())
        arrays.launch("similarity_slopes", of_windows, loss, slopes, similar)
    arrays.launch("amplitude_loss", of_pixels, loss, slopes, sums)
    arrays.launch("sum_loss", 1, loss, sums, c_int64(of_pixels), similar, c_int64(of_windows))


def _normal_lobes(arrays: Arrays, lobes: ctypes.Structure) -> None:
    kernel = "normal_lobes_backward" if lobes.d_amplitudes else "normal_lobes"
    arrays.launch(kernel, -(-lobes.gaussians // THREADS), lobes)


@dataclass(frozen=True)
class Operation:
    """Function that fills in the structure of an operation, and maxima of its numbers."""

    run: Callable[[Arrays, ctypes.Structure], None]
    limits: Mapping[str, float] = field(default_factory=dict)


OPERATIONS = {
    "adam": Operation(_adam, LIMITS["adam"]),
    "amplitude_loss": Operation(_amplitude_loss),
    "lit_ground": Operation(lit_ground),
    "lit_terrain": Operation(lit_terrain),
    "normal_lobes": Operation(_normal_lobes),
}
"""Operations with kernels, by their names in csrc/api.h."""
