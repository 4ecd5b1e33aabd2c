"""What Gaussians return towards the views of a call; of a training's usual law by an engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import Structure
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, NormalLobes
from sarsplat.geometry import View
from sarsplat.renderer.engines.passes import Pass
from sarsplat.renderer.engines.problem import directions_to
from sarsplat.renderer.engines.structs import Lobes
from sarsplat.renderer.once import differentiable_once


def amplitudes_towards(
    new_pass: Callable[[], Pass], gaussians: Gaussians, views: Sequence[View]
) -> Float[Tensor, "v n c"]:
    """`Gaussians.amplitudes` towards the radar of each view, of float32 on an engine's passes; differentiable once."""
    law = gaussians.scattering
    directions = directions_to(views, gaussians.means)
    if type(law) is NormalLobes and gaussians.means.dtype == torch.float32:
        return _Engine.apply(new_pass, directions, law, gaussians.quaternions, gaussians.scales, law.parameters)
    return gaussians.amplitudes(directions)


class _Engine(torch.autograd.Function):
    """`NormalLobes.amplitudes`, as there without a gradient of the scales."""

    @staticmethod
    def forward(
        ctx: Any, new_pass: Callable[[], Pass], directions: Tensor, law: NormalLobes, *inputs: Tensor
    ) -> Tensor:
        kept = [tensor.contiguous() for tensor in (directions, *inputs)]
        ctx.save_for_backward(*kept)
        ctx.new_pass, ctx.p_min = new_pass, law.p_min
        made = directions.new_empty(len(directions), len(inputs[0]), 1)
        new_pass().normal_lobes(_problem(ctx.p_min, kept, made))
        return made

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, seed: Tensor) -> tuple[Tensor | None, ...]:
        _, quaternions, _, parameters = kept = ctx.saved_tensors
        gradients, seed = (torch.empty_like(quaternions), torch.empty_like(parameters)), seed.contiguous()
        ctx.new_pass().normal_lobes_backward(_problem(ctx.p_min, kept, None, seed, *gradients))
        return None, None, None, gradients[0], None, gradients[1]


def _problem(p_min: float, kept: Sequence[Tensor], *others: Tensor | None) -> Structure:
    """Inputs as `forward` has them, then what comes out, its seed and gradients."""
    directions, quaternions, *_ = kept
    pointers = (None if tensor is None else tensor.data_ptr() for tensor in (*kept, *others))
    return Lobes(len(directions), p_min, len(quaternions), *pointers)
