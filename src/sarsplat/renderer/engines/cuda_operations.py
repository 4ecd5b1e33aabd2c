"""Operations on a GPU: arrays and launches. To add one, write a function and list it in `OPERATIONS`."""

import ctypes
from collections.abc import Callable, Sequence
from ctypes import c_int32, c_int64, c_void_p
from typing import Any

import torch
from torch import Tensor

from sarsplat.renderer.engines.abi import SOURCES, api, structures
from sarsplat.renderer.engines.bounds import TILE
from sarsplat.renderer.engines.cuda_device import THREADS, Arrays

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


# ---- ground ----------------------------------------------------------------------------------------------------------
_GroundState, _TerrainState = (
    structures((SOURCES / f"cuda_{name.lower()}.cuh").read_text(encoding="utf-8"), (f"{name}State",))[f"{name}State"]
    for name in ("Ground", "Terrain")
)

# of csrc/cuda_ground.cuh
_ROWS, _COLUMNS = 8, 32
_RESPONSE_END = 6.0


def _lit_ground(on: Arrays, ground: ctypes.Structure) -> None:
    """Fill in the lit share of the ground, or its gradients."""
    patches = ground.patches[: ground.of_views]
    rows, columns = (max(one.count for one in axes) for axes in zip(*((p.rows, p.columns) for p in patches)))
    azimuth_std, range_std = ground.std
    widths = [_width(axis, std) for p in patches for axis, std in ((p.rows, range_std), (p.columns, azimuth_std))]
    call = _with_patches(on, ground, patches)
    state = _weighed(on, call, ground.rows.count + ground.columns.count, widths, columns, bool(ground.d_shift))
    state.between = on.new("between", ground.views, ground.rows.count, columns).data_ptr()

    def over(kernel: str, rows: int, columns: int) -> None:
        blocks = _blocks(rows, columns)
        on.launch(kernel, ground.views * blocks, call, state, c_int32(blocks))

    if not ground.d_lit:
        over("see_ground", ground.rows.count, columns)
        over("light_ground", ground.rows.count, ground.columns.count)
        return
    blocks = _blocks(ground.rows.count, columns)
    state.shares = on.new("shares", 2, ground.views, blocks).data_ptr()
    over("light_ground_backward", ground.rows.count, columns)
    over("see_ground_backward", rows, columns)
    if ground.d_shift:
        on.launch("sum_ground_shift", 2 * ground.views, call, state, c_int32(blocks))


def _lit_terrain(on: Arrays, terrain: ctypes.Structure) -> None:
    """Fill in β⁰ of terrain, or its gradients."""
    patches, views, columns = terrain.patches[: terrain.of_views], terrain.views, terrain.columns.count
    rows, across = max(one.rows for one in patches), max(one.across.count for one in patches)
    traced = [max(one.traced[axis] for one in patches) for axis in range(2)]
    places, cells = terrain.places[0] * terrain.places[1], max(one.rows * one.across.count for one in patches)
    call = _with_patches(on, terrain, patches)
    # columns alone, as if the ground were level
    level = api.ground(
        views=views, columns=terrain.columns, std=terrain.std, shift=terrain.shift, chosen=terrain.chosen
    )
    level = _with_patches(on, level, [api.patches(columns=one.across) for one in patches])
    widths = [_width(one.across, terrain.std[0]) for one in patches]
    ground = _weighed(on, level, columns, widths, across, bool(terrain.d_shift))
    state = _TerrainState(cells=cells, columns=across)

    def arrays(*names: str, of: tuple[int, ...], dtype: torch.dtype = torch.float32) -> list[Tensor]:
        made = [on.new(name, views, *of, dtype=dtype) for name in names]
        for name, array in zip(names, made, strict=True):
            setattr(state, name, array.data_ptr())
        return made

    def over(kernel: str, rows: int, columns: int, *states: ctypes.Structure) -> None:
        blocks = _blocks(rows, columns)
        on.launch(kernel, views * blocks, call, *states, c_int32(blocks))

    arrays("returned", of=(cells,))
    over("return_cells", rows, across, state)
    if not terrain.d_lit or terrain.d_shift:
        arrays("reached", "ahead", of=(cells,))
        arrays("seen", of=(terrain.rows.count, across))
        strips = -(-across // _COLUMNS)
        on.launch("reach_cells", views * strips, call, state, c_int32(strips))
        over("see_cells", terrain.rows.count, across, state)
    if not terrain.d_lit:
        over("light_terrain", terrain.rows.count, columns, ground, state)
        return
    arrays("told", of=(cells,))
    arrays("between", of=(terrain.rows.count, across))
    (largest,), (sums,) = arrays("largest", of=(), dtype=torch.int32), arrays("sums", of=(places,), dtype=torch.int64)
    largest.zero_()
    sums.zero_()
    shares = _blocks(terrain.rows.count, across), _blocks(rows, across)
    if terrain.d_shift:
        arrays("azimuth", of=shares[:1])
        arrays("range", of=shares[1:])
    over("light_terrain_backward", terrain.rows.count, across, ground, state)
    over("see_cells_backward", rows, across, state)
    over("tell_rays", *traced, state)
    over("tell_places", rows, across, state)
    on.launch("write_places", -(-views * places // THREADS), call, state)
    if terrain.d_shift:
        on.launch("sum_terrain_shift", views, call, state, *map(c_int32, shares))


def _with_patches(on: Arrays, call: ctypes.Structure, patches: Sequence[ctypes.Structure]) -> ctypes.Structure:
    """Return a copy of a call whose patches are on the device."""
    copy = type(call).from_buffer_copy(call)
    on_device = on.keep(f"patches of {type(call).__name__}", on.sent(b"".join(patches)))
    copy.patches = ctypes.cast(on_device.data_ptr(), type(copy.patches))
    return copy


def _weighed(
    on: Arrays, ground: ctypes.Structure, pixels: int, widths: Sequence[int], columns: int, slopes: bool
) -> ctypes.Structure:
    """Weigh the patches in the responses of pixels; also return the weights' slopes if asked for."""
    state = _GroundState(width=max(1, *widths), columns=columns)
    for name in ("first", "end"):
        setattr(state, name, on.new(name, ground.views, pixels, dtype=torch.int32).data_ptr())
    for name in ("weight", "slope") if slopes else ("weight",):
        setattr(state, name, on.new(name, ground.views, pixels, state.width).data_ptr())
    on.launch("weigh_ground", -(-ground.views * pixels * state.width // THREADS), ground, state)
    return state


def _width(patches: Any, std: float) -> int:
    """Return the maximum number of patches in a pixel's response."""
    across = 2 * _RESPONSE_END * std / patches.step
    return min(patches.count, int(across) + 3) if across < patches.count else patches.count


def _blocks(rows: int, columns: int) -> int:
    return -(-rows // _ROWS) * -(-columns // _COLUMNS)


# ---- all of them -----------------------------------------------------------------------------------------------------
OPERATIONS: dict[str, Callable[[Arrays, ctypes.Structure], None]] = {
    "adam": _adam,
    "amplitude_loss": _amplitude_loss,
    "lit_ground": _lit_ground,
    "lit_terrain": _lit_terrain,
    "normal_lobes": _normal_lobes,
}
"""Functions that fill in the structure of an operation, by the operation's name in csrc/api.h."""
