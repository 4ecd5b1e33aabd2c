"""The ground in images: what it hides, and what it returns where the radar sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import embedding

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, View, radar_frame


def above(gaussians: Gaussians, ground: Ground) -> Gaussians:
    """Those whose centres are above the ground; the others are hidden below it, and thin as air."""
    hidden = gaussians.means[:, 2] < ground.height_m
    return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))


def check_ground(ground: Ground, like: Tensor, channels: int, channel: int, imaging_weight: str) -> None:
    """Refuse what does not fit the Gaussians and the images."""
    for name, tensor in (("gamma0", ground.gamma0), ("exponent", ground.exponent)):
        if tensor is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
            raise SarsplatError(
                f"ground.{name} is {tensor.dtype} on {tensor.device} but means is {like.dtype} on {like.device}; use "
                "one floating dtype and one device for all tensors"
            )
    if imaging_weight == "peak":
        raise SarsplatError("imaging_weight='peak' gives images without a unit, to which no ground can be added")
    if channel >= channels:
        raise SarsplatError(
            f"the ground returns power in channel {channel}, but amplitudes have {channels} channels; give those "
            "of all its channels"
        )


def ground_values(ground: Ground) -> dict[str, Tensor | None]:
    """What must be in range, by name."""
    exponent = None if ground.exponent is None else ground.exponent.reshape(1)
    return {"ground.gamma0": ground.gamma0.reshape(-1), "ground.exponent": exponent}


def with_ground(
    images: Float[Tensor, "v c h w"],
    ground: Ground,
    lit: Float[Tensor, "v h w"],
    channel: int,
    views: Sequence[View],
    grid: ImageGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Float[Tensor, "v c h w"]:
    """Images with what the lit ground returns in their channel of power."""
    returned = lit * free_ground(ground, views, grid, shift)
    power = torch.arange(images.shape[1], device=images.device) == channel
    return images + (returned[:, None] if len(power) == 1 else returned[:, None] * power.to(images)[:, None, None])


def free_ground(
    ground: Ground, views: Sequence[View], grid: ImageGrid, shift: Float[Tensor, "v 2"] | None = None
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """β⁰ of the ground that nothing hides."""
    table, device = ground.gamma0, ground.gamma0.device
    numbers = torch.stack([_of_view(view, device) for view in views]).to(table).T[..., None, None]
    tangent, log_sine, sine, *onto = numbers  # [V, 1, 1] each
    level = tangent if ground.exponent is None else tangent * (ground.exponent * log_sine).exp()
    if table.numel() == 1:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return (table.reshape(()) * level).expand(-1, 1, grid.columns).expand(-1, grid.rows, -1)
    x, r = (axis.to(table) for axis in _axes(grid, device))
    if shift is not None:
        x, r = x - shift[:, None, :1], r - shift[:, 1:, None]
    r = r + sine * ground.height_m  # r = ground range · cos θ − z · sin θ
    (column, right, next_column), (row, down, next_row) = (
        _between(across * x + along * r, ground.pitch_m, count)
        for across, along, count in zip(onto[:2], onto[2:], reversed(table.shape), strict=True)
    )
    flat, at, step = table.reshape(-1), row * table.shape[1] + column, next_row * table.shape[1]
    upper = torch.lerp(_rows(flat, at), _rows(flat, at + next_column), right)
    lower = torch.lerp(_rows(flat, at + step), _rows(flat, at + step + next_column), right)
    return torch.lerp(upper, lower, down) * level


def _between(
    place_m: Float[Tensor, "v h w"], pitch_m: float, count: int
) -> tuple[Int64[Tensor, "v h w"], Float[Tensor, "v h w"], int]:
    """The places before, how far on it is to the next ones, and how many numbers on those are."""
    place = (place_m / pitch_m + (count - 1) / 2).clamp(0, count - 1)
    before = place.detach().floor().clamp(max=max(count - 2, 0))
    return before.long(), place - before, min(count - 1, 1)


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@lru_cache(maxsize=4096)
def _of_view(view: View, device: torch.device) -> Float64[Tensor, " 7"]:
    """Of θ: tan, ln sin and sin; and how x and y on the ground grow with azimuth and with slant range."""
    frame, theta = radar_frame(view), math.radians(view.grazing_deg)
    numbers = [math.tan(theta), math.log(math.sin(theta)), math.sin(theta)]
    return torch.tensor(
        [*numbers, *frame[0, :2], *(frame[2, :2] / math.cos(theta) ** 2)], dtype=torch.float64, device=device
    )


@lru_cache(maxsize=16)
def _axes(grid: ImageGrid, device: torch.device) -> tuple[Float64[Tensor, "1 1 w"], Float64[Tensor, "1 h 1"]]:
    """Azimuth and slant range of the pixels, m."""
    x, r = torch.from_numpy(grid.azimuth_m), torch.from_numpy(grid.range_m)
    return x[None, None].to(device), r[None, :, None].to(device)


def _rows(table: Float[Tensor, " n"], index: Tensor) -> Tensor:
    """`table[index]`, whose gradient is summed in the same order in every run."""
    if table.is_cuda:
        return embedding(index, table[:, None])[..., 0]
    return table.index_select(0, index.reshape(-1)).view(index.shape)  # twenty times as fast on a CPU
