"""The ground in images: what it hides, and what it returns where the radar sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import embedding

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.radiometry import beta0_of_gamma0


def above(gaussians: Gaussians, ground: Ground) -> Gaussians:
    """Those whose centres are above the ground; the others are hidden below it, and thin as air."""
    hidden = gaussians.means[:, 2] < ground.height_m
    return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))


def check_ground(ground: Ground, like: Tensor, channels: int, channel: int, imaging_weight: str) -> None:
    """Refuse what does not fit the Gaussians and the images."""
    if not isinstance(ground, Ground):
        raise SarsplatError(f"ground is a {type(ground).__name__}; give a sarsplat.Ground")
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
    shifts = [None] * len(views) if shift is None else shift.unbind()
    return torch.stack([_beta0(ground, view, grid, moved) for view, moved in zip(views, shifts, strict=True)])


def _beta0(
    ground: Ground, view: View, grid: ImageGrid, shift: Float[Tensor, " 2"] | None
) -> Float[Tensor, "{grid.rows} {grid.columns}"]:
    """`free_ground` of one view."""
    gamma0 = ground.gamma0
    if ground.exponent is not None:
        gamma0 = gamma0 * math.sin(math.radians(view.grazing_deg)) ** ground.exponent
    beta0 = beta0_of_gamma0(gamma0, view.grazing_deg)
    if beta0.numel() == 1:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return beta0.reshape(1, 1).expand(1, grid.columns).expand(grid.rows, -1)
    frame, cosine = radar_frame(view), math.cos(math.radians(view.grazing_deg))
    x, r = (torch.from_numpy(axis).to(beta0) for axis in (grid.azimuth_m, grid.range_m))
    x, r = (x, r) if shift is None else (x - shift[0], r - shift[1])
    away = (r - frame[2, 2] * ground.height_m) / cosine  # ground range: r = away·cos θ − z·sin θ
    sides = []
    for axis, count in ((0, beta0.shape[1]), (1, beta0.shape[0])):
        place = frame[0, axis] * x + frame[2, axis] / cosine * away[:, None]
        place = (place / ground.pitch_m + (count - 1) / 2).clamp(0, count - 1)
        below = place.detach().floor().clamp(max=max(count - 2, 0))
        sides.append((below.long(), place - below, min(count - 1, 1)))
    (column, right, next_column), (row, down, next_row) = sides
    table, at = beta0.reshape(-1), row * beta0.shape[1] + column
    step = next_row * beta0.shape[1]
    upper = _rows(table, at) * (1 - right) + _rows(table, at + next_column) * right
    lower = _rows(table, at + step) * (1 - right) + _rows(table, at + step + next_column) * right
    return upper * (1 - down) + lower * down


def _rows(table: Float[Tensor, " n"], index: Tensor) -> Tensor:
    """`table[index]`, whose gradient is summed in the same order in every run."""
    if table.is_cuda:
        return embedding(index, table[:, None])[..., 0]
    return table.index_select(0, index.reshape(-1)).view(index.shape)  # twenty times as fast on a CPU
