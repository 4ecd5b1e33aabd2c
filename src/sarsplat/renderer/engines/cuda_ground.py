"""How much of the ground pixels see, on a GPU: the arrays of its kernels, and their launches."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_int32
from typing import Any, Protocol

import torch
from torch import Tensor

from sarsplat.renderer.engines.abi import SOURCES, api, structures

_State = structures((SOURCES / "cuda_ground.cuh").read_text(encoding="utf-8"), ("GroundState",))["GroundState"]

# of csrc/cuda_state.cuh and csrc/cuda_ground.cuh
_THREADS, _ROWS, _COLUMNS = 256, 8, 32
_RESPONSE_END = 6.0


class New(Protocol):
    """A new array on the device."""

    def __call__(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor: ...


def lit_ground(
    ground: ctypes.Structure, new: New, sent: Callable[[bytes], Tensor], launch: Callable[..., None]
) -> None:
    """Fill in what is lit of the ground, or the gradients of that.

    `sent` is a copy on the device, and `launch` takes a kernel's name, how many blocks, and its arguments.
    """
    patches = ground.patches[: ground.of_views]
    rows, columns = (max(one.count for one in axes) for axes in zip(*((p.rows, p.columns) for p in patches)))
    pixels = ground.views, ground.rows.count + ground.columns.count
    azimuth_std, range_std = ground.std
    widths = [_width(axis, std) for p in patches for axis, std in ((p.rows, range_std), (p.columns, azimuth_std))]
    state = _State(width=max(1, *widths), columns=columns)
    for name in ("first", "end"):
        setattr(state, name, new(name, *pixels, dtype=torch.int32).data_ptr())
    for name in ("weight", "slope") if ground.d_shift else ("weight",):
        setattr(state, name, new(name, *pixels, state.width).data_ptr())
    state.between = new("between", ground.views, ground.rows.count, columns).data_ptr()

    def over(kernel: str, rows: int, columns: int) -> None:
        blocks = _blocks(rows, columns)
        launch(kernel, ground.views * blocks, there, state, c_int32(blocks))

    there = api.ground.from_buffer_copy(ground)
    on_device = sent(ctypes.string_at(ground.patches, ctypes.sizeof(api.patches) * ground.of_views))
    there.patches = ctypes.cast(on_device.data_ptr(), type(there.patches))
    launch("weigh_ground", -(-pixels[0] * pixels[1] * state.width // _THREADS), there, state)
    if not ground.d_lit:
        over("see_ground", ground.rows.count, columns)
        over("light_ground", ground.rows.count, ground.columns.count)
        return
    blocks = _blocks(ground.rows.count, columns)
    state.shares = new("shares", 2, ground.views, blocks).data_ptr()
    over("light_ground_backward", ground.rows.count, columns)
    over("see_ground_backward", rows, columns)
    if ground.d_shift:
        launch("sum_ground_shift", 2 * ground.views, there, state, c_int32(blocks))


def _width(patches: Any, std: float) -> int:
    """How many of them a pixel sees at most."""
    across = 2 * _RESPONSE_END * std / patches.step
    return min(patches.count, int(across) + 3) if across < patches.count else patches.count


def _blocks(rows: int, columns: int) -> int:
    """Of a table."""
    return -(-rows // _ROWS) * -(-columns // _COLUMNS)
