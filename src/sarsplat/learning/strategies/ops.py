"""Row operations that remove, duplicate, split and move Gaussians in parameters, optimiser and strategy state.

They work on any dictionary of parameters; the optimiser lists those with a row for each Gaussian. New Gaussians have no
momentum. Each function returns the source of each row, so that other arrays can follow.
"""

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from sarsplat.gaussians.gaussians import rotated
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Params, State

_SPLIT_SHRINK = 1.6  # ratio of a Gaussian's widths to those of its two parts after a split
_RELOCATED_DEPTH = 0.6  # factor on both optical depths; .5 and .7 were worse (docs/lab/2026-11-clean-surfaces.md)
_TOTAL = 2.0**61  # total of the integers that represent values in `whole_sums`


def rearrange(
    params: Params, optimizers: Optimiser, state: State, source: Int64[Tensor, " m"], kept: Bool[Tensor, " m"]
) -> None:
    """Make row k of every per-Gaussian tensor from row `source`[k]; moments and state are 0 where not `kept`[k].

    `params` gets new leaves unless the number of rows stays.
    """
    for name in optimizers.rows:
        rows = params[name].detach()[source]
        if len(rows) == len(params[name]):
            params[name].detach().copy_(rows)
        else:
            params[name] = rows.requires_grad_()
    optimizers.follow(source, kept)
    state.follow(source, kept)


def remove(params: Params, optimizers: Optimiser, state: State, gone: Bool[Tensor, " n"]) -> Int64[Tensor, " m"]:
    source = (~gone).nonzero()[:, 0]
    rearrange(params, optimizers, state, source, torch.ones_like(source, dtype=torch.bool))
    return source


def duplicate(params: Params, optimizers: Optimiser, state: State, which: Bool[Tensor, " n"]) -> Int64[Tensor, " m"]:
    return _append(params, optimizers, state, torch.ones_like(which).nonzero()[:, 0], which.nonzero()[:, 0])


def split(
    params: Params, optimizers: Optimiser, state: State, which: Bool[Tensor, " n"], generator: torch.Generator
) -> Int64[Tensor, " m"]:
    """Replace each of these Gaussians by two smaller ones at random places in it, appended at the end.

    The parameters must have `means`, `quaternions` and `scales`.
    """
    parts = which.nonzero()[:, 0].repeat(2)
    offset = _inside(params, parts, generator)
    source = _append(params, optimizers, state, (~which).nonzero()[:, 0], parts)
    with torch.no_grad():
        params["means"][len(source) - len(parts) :] += offset
        params["scales"][len(source) - len(parts) :] *= 1 / _SPLIT_SHRINK
    return source


def relocate(
    params: Params,
    optimizers: Optimiser,
    state: State,
    idle: Int64[Tensor, " m"],
    joined: Int64[Tensor, " m"],
    generator: torch.Generator,
) -> Int64[Tensor, " n"]:
    """Divide each joined Gaussian between itself and an idle one, which move in opposite directions.

    The parameters must have `means`, `quaternions`, `scales` and `optical_depth`.
    """
    offset = _inside(params, joined, generator)
    source = torch.arange(len(params["means"]), device=offset.device).index_copy(0, idle, joined)
    changed = torch.cat([idle, joined])
    kept = torch.ones_like(source, dtype=torch.bool).index_fill(0, changed, False)
    rearrange(params, optimizers, state, source, kept)
    with torch.no_grad():
        params["means"][changed] += torch.cat([offset, -offset])
        params["optical_depth"][changed] *= _RELOCATED_DEPTH
    return source


def _append(
    params: Params, optimizers: Optimiser, state: State, stay: Int64[Tensor, " k"], more: Int64[Tensor, " m"]
) -> Int64[Tensor, " n"]:
    """Rearrange to the rows that stay, and copies of rows as new Gaussians."""
    source = torch.cat([stay, more])
    rearrange(params, optimizers, state, source, torch.arange(len(source), device=source.device) < len(stay))
    return source


def _inside(params: Params, rows: Int64[Tensor, " m"], generator: torch.Generator) -> Float[Tensor, "m 3"]:
    """Random offsets from the centres of Gaussians, drawn from the Gaussians, m."""
    scales, quaternions = params["scales"].detach()[rows], params["quaternions"].detach()[rows]
    along = torch.randn(len(rows), 3, generator=generator, dtype=torch.float32, device="cpu").to(scales) * scales
    return rotated(quaternions, along)


def running_sums(values: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Cumulative sums of values ≥ 0, with the same bits each time.

    A GPU adds floating-point numbers in varying order, so there they become integers.
    """
    if values.device.type == "cpu":
        return values.cumsum(0)
    return whole_sums(values)


def whole_sums(values: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Cumulative sums rounded to 2⁻⁶¹ of the total, independent of the order of additions."""
    scale = _TOTAL / values.sum().clamp(min=torch.finfo(values.dtype).tiny * _TOTAL)
    return (values * scale).long().cumsum(0).double() / scale
