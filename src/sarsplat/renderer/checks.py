"""Checks of the renderer's arguments. The engines check values as they read them."""

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor

from sarsplat.arguments import check_number, expect
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians
from sarsplat.gaussians.gaussians import check_same_kind
from sarsplat.geometry import ImageGrid, View

MAX_SCALE = 1e6
"""Maximum scale, m: squares of larger variances overflow float32."""

FARTHEST, STRONGEST = 1e9, 1e15
"""Maximum lengths, m, and maxima of all other numbers: larger ones overflow float32."""

FLATTEST, STEEPEST = 1e-8, 1e8
"""Limits of the roots of footprints, 1/m."""

_OF_BOTH = 2 * FARTHEST  # of a mean and a shift
_LENGTHS = {"means": FARTHEST, "shift": FARTHEST, "centers": _OF_BOTH, "range_m": _OF_BOTH}
_NUMBERS = ("scattering", "gain", "ground.gamma0", "ground.exponent", "tilt", "amplitudes", "cross_sections", "slopes")
_MAX_ABS = {**_LENGTHS, **dict.fromkeys(_NUMBERS, STRONGEST), "roots": STEEPEST}
_POSITIVE = "optimise logarithms, or clamp"
ALLOWED = {
    **{name: f"finite metres, at most {most:g}" for name, most in _LENGTHS.items()},
    **dict.fromkeys(_NUMBERS, f"finite, at most {STRONGEST:g}"),
    "quaternions": f"finite and not zero, of a length between {1 / STRONGEST:g} and {STRONGEST:g}",
    "scales": f"finite and at least MIN_SCALE = {MIN_SCALE} m, at most {MAX_SCALE:g} m: {_POSITIVE}",
    "optical_depth": f"between 0 and MAX_OPTICAL_DEPTH = {MAX_OPTICAL_DEPTH:g}: {_POSITIVE}",
    "roots": f"finite, at most {STEEPEST:g} per metre, and the first and the last of the three at least {FLATTEST:g}",
}
"""Requirements on each tensor, for messages."""

_MAX_PIXELS = 32_767  # maximum side of an image on the CPU engine; up to 4,096 was measured


def check_shapes(
    gaussians: Gaussians, views: Sequence[View], amplitudes: Tensor | None, shift: Tensor | None, gain: Tensor | None
) -> None:
    """Raise if there are no views, or a tensor has a shape that does not fit them."""
    if not views:
        raise SarsplatError("there are no views to render; give at least one View")
    v, n = len(views), len(gaussians)
    for name, tensor, shape in (("shift", shift, (v, 2)), ("gain", gain, (v,))):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}; for {v} views it must be {shape}")
    if amplitudes is not None:
        check_channels("amplitudes", amplitudes, v, n)
        if amplitudes.is_complex():
            raise SarsplatError(
                f"amplitudes is {amplitudes.dtype}; render takes real ones, sarsplat.splat complex ones"
            )


def check_channels(name: str, tensor: Tensor, views: int, gaussians: int) -> None:
    """Raise unless a tensor is [V, N, C], with at least one channel."""
    if tensor.ndim != 3 or tensor.shape[:2] != (views, gaussians) or not tensor.shape[2]:
        raise SarsplatError(
            f"{name} has shape {tuple(tensor.shape)}; for {views} views of {gaussians} Gaussians it must be "
            f"({views}, {gaussians}, C) with at least one channel"
        )


def check_options(*, imaging_weight: str = "area", first_return_depth: float | None = None) -> None:
    """Raise if an option is not among its choices, or out of range."""
    expect(Literal["area", "peak"], imaging_weight=imaging_weight)
    if first_return_depth is not None:
        check_number("first_return_depth", first_return_depth, 0, above=True)


def check_for_cpu(grid: ImageGrid | None, tensors: Mapping[str, Tensor | None]) -> None:
    """Raise if the CPU engine does not support the image or a tensor."""
    if grid is not None and max(grid.rows, grid.columns) > _MAX_PIXELS:
        raise SarsplatError(
            f"an image of {grid.rows} × {grid.columns} pixels is too large for the CPU engine; "
            f"render parts of at most {_MAX_PIXELS} pixels per side by moving the grid's center"
        )
    words = "CPU engine takes torch.float32 on the CPU (engine='reference' takes torch.float64 too)"
    _check_single(tensors, "cpu", words)


def check_for_cuda(tensors: Mapping[str, Tensor | None]) -> int:
    """Raise if the CUDA engine does not support a tensor; return the index of the GPU."""
    words = "CUDA engine takes torch.float32 on a GPU (move it with .to('cuda'), or use engine='cpu')"
    _check_single(tensors, "cuda", words)
    check_same_kind(tensors)
    return next(tensor.device.index for tensor in tensors.values() if tensor is not None)


def _check_single(tensors: Mapping[str, Tensor | None], device_type: str, words: str) -> None:
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype, tensor.device.type) != (torch.float32, device_type):
            raise SarsplatError(f"{name} is {tensor.dtype} on {tensor.device}; the {words}")


def check_values(tensors: Mapping[str, Tensor | None], *, by_view: bool = False) -> None:
    """Raise if a value is out of range, with its row; of tensors [V, N, ...] if `by_view`, with a name's last part."""
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        of_pairs = by_view or name == "amplitudes"
        good = _in_range(name.rpartition(".")[2] if by_view else name, tensor.flatten(0, 1) if of_pairs else tensor)
        if not bool(good.all()):
            raise SarsplatError(complaint(name, tensor, int((~good).nonzero()[0, 0]), by_view=of_pairs))


def check_for_reference(tensors: Mapping[str, Tensor | None], *, by_view: bool = False) -> None:
    """Raise if the reference does not support the dtype of the first tensor, or a value is out of range."""
    name, first = next(iter(tensors.items()))
    if first is not None and first.dtype not in (torch.float32, torch.float64):
        raise SarsplatError(
            f"{name} is {first.dtype}, not precise enough for the reference; use torch.float64 or torch.float32"
        )
    check_values(tensors, by_view=by_view)


def _in_range(name: str, rows: Tensor) -> Tensor:
    """Return True for values, or rows, in their range; those of a custom echo need only be finite."""
    match name:
        case "scales":
            return (rows >= MIN_SCALE * (1 - 1e-6)) & (rows <= MAX_SCALE)
        case "optical_depth":
            return (rows >= 0) & (rows <= MAX_OPTICAL_DEPTH * (1 + 1e-6))
        case "quaternions":
            length = rows.double().norm(dim=1)
            return (length >= 1 / STRONGEST) & (length <= STRONGEST)
        case "roots":
            return (rows.abs() <= STEEPEST) & (rows[:, [0, 0, 2]] >= FLATTEST)  # a and c
        case _:
            return rows.abs() <= _MAX_ABS[name] if name in _MAX_ABS else rows.isfinite()


def complaint(name: str, tensor: Tensor, index: int, *, by_view: bool = False) -> str:
    """Return the message for an invalid row; of a tensor [V, N, ...] if `by_view`, counted over both."""
    at = divmod(index, tensor.shape[1]) if by_view else (index,)
    allowed = ALLOWED.get(name.rpartition(".")[2] if by_view else name, "finite")
    return f"{name}[{', '.join(map(str, at))}] is {tensor[at].tolist()}; it must be {allowed}"
