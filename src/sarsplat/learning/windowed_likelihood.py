"""The likelihood of stacks as a training takes it: averaged around each pixel, by the engine where it can."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Float32, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.learning import adam
from sarsplat.learning.stack_loss import covariance_nats, refuse_failed
from sarsplat.renderer.engines import cpu, structs
from sarsplat.renderer.once import differentiable_once
from sarsplat.renderer.planes import Planes

_MOST_CHANNELS = 16
"""That the engine takes."""


@dataclass(frozen=True)
class ExpectedStacks:
    """What is expected of stacks: covariances, noise of each channel, and phases besides, rad."""

    planes: Planes
    noise: Float[Tensor, "v p"] | None
    phases: Float[Tensor, "v p rows columns"] | None

    def whole(self) -> Complex[Tensor, "v p p rows columns"]:
        """Hermitian matrices."""
        covariances = self.planes.whole(self.phases)
        if self.noise is None:
            return covariances
        noise = self.noise.expand(covariances.shape[:2])
        return covariances + torch.diag_embed(noise).to(covariances.dtype)[..., None, None]


def windowed(
    covariances: Complex[Tensor, "v p p rows columns"], level: Float[Tensor, "v p rows columns"], window: int
) -> Complex[Tensor, "v p p rows columns"]:
    """With the phases of level ground taken out, rad, and averaged around each pixel, at edges over what there is."""
    turned = torch.polar(torch.ones_like(level), -level)
    deramped = covariances * (turned[:, :, None] * turned[:, None].conj())
    parts = torch.view_as_real(deramped).movedim(-1, 3).flatten(0, 3)
    mean = avg_pool2d(parts[:, None], window, 1, window // 2, count_include_pad=False)[:, 0]
    v, p = covariances.shape[:2]
    return torch.view_as_complex(mean.unflatten(0, (v, p, p, 2)).movedim(3, -1).contiguous())


def packed(covariances: Complex[Tensor, "v p p rows columns"]) -> Float[Tensor, "v q rows columns"]:
    """The diagonals of Hermitian matrices, then of channels i < j real and imaginary parts in turn: P² numbers."""
    first, second = np.triu_indices(covariances.shape[1], 1)
    diagonal = torch.diagonal(covariances, dim1=1, dim2=2).real.movedim(-1, 1)
    pairs = torch.view_as_real(covariances[:, first, second].contiguous()).movedim(-1, 2).flatten(1, 2)
    return torch.cat([diagonal, pairs], dim=1).contiguous()


def unpacked(parts: Float[Tensor, "v q rows columns"], count: int) -> Complex[Tensor, "v {count} {count} rows columns"]:
    """Undo `packed`."""
    first, second = np.triu_indices(count, 1)
    v, _, *size = parts.shape
    result = parts.new_zeros((v, count, count, *size), dtype=parts.dtype.to_complex())
    result[:, range(count), range(count)] = parts[:, :count].to(result)
    if count > 1:
        pairs = torch.view_as_complex(parts[:, count:].unflatten(1, (-1, 2)).movedim(2, -1).contiguous())
        result[:, first, second], result[:, second, first] = pairs, pairs.conj()
    return result


def windowed_nats(
    expected: ExpectedStacks,
    level: Float[Tensor, "v p rows columns"],
    samples: Float[Tensor, "v q rows columns"],
    window: int,
) -> Float[Tensor, ""]:
    """`stack_nats` of `packed` samples that were `windowed`, and of expected covariances that are here.

    Noise is added afterwards. float32 on the CPU is one call of the engine, anything else plain torch.
    """
    planes, count = expected.planes, level.shape[1]
    assert expected.noise is not None
    if count <= _MOST_CHANNELS and adam.engine_takes((planes.powers, samples)):
        phases = level - planes.turns[..., None]
        if expected.phases is not None:
            phases = phases - expected.phases
        nats: Float[Tensor, ""] = _EngineNats.apply(
            planes.powers,
            planes.pairs,
            phases,
            expected.noise,
            samples,
            torch.tensor(planes.of_channels, dtype=torch.int32),
            torch.tensor(planes.of_pairs, dtype=torch.int32),
            window // 2,
        )
        return nats
    mean = windowed(planes.whole(expected.phases), level, window)
    noise = torch.diag_embed(expected.noise).to(mean.dtype)[..., None, None]
    return covariance_nats(mean + noise, unpacked(samples, count))


class _EngineNats(torch.autograd.Function):
    """The likelihood and its gradients in one go; differentiable once, with respect to all but samples."""

    @staticmethod
    def forward(
        ctx: Any,
        powers: Float32[Tensor, "v k rows columns"],
        pairs: Float32[Tensor, "v d rows columns"],
        phases: Float32[Tensor, "v p rows columns"],
        noise: Float32[Tensor, "v p"],
        samples: Float32[Tensor, "v q rows columns"],
        of_channels: Tensor,
        of_pairs: Tensor,
        reach: int,
    ) -> Float[Tensor, ""]:
        inputs = [tensor.contiguous() for tensor in (powers, pairs, phases, noise)]
        learned = [
            torch.empty_like(tensor) if k != 2 or ctx.needs_input_grad[2] else None for k, tensor in enumerate(inputs)
        ]
        samples, value = samples.contiguous(), powers.new_empty(())
        failed: Int64[Tensor, ""] = torch.zeros((), dtype=torch.int64)
        (v, k, rows, columns), d, p = powers.shape, pairs.shape[1] // 2, phases.shape[1]
        pointers = (
            None if tensor is None else tensor.data_ptr()
            for tensor in (*inputs[:2], of_channels, of_pairs, *inputs[2:], samples, value, *learned, failed)
        )
        cpu.Pass().stack_likelihood(structs.Likelihood(v, rows, columns, p, k, d, reach, *pointers))
        refuse_failed(int(failed))
        ctx.save_for_backward(*learned)
        return value

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return *(None if of is None else of * slope for of in ctx.saved_tensors), None, None, None, None
