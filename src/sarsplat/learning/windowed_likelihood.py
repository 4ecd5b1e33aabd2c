"""Training loss of stacks: likelihood of covariances averaged around each pixel, by the engine if it can."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.learning.stack_loss import covariance_nats, refuse_failed
from sarsplat.renderer.covariances import Planes
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.operation import Operation


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
    """Covariances deramped by the phases of level ground, rad, and averaged over the window around each pixel."""
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
    planes = expected.planes
    assert expected.noise is not None
    phases = level - planes.turns[..., None]
    if expected.phases is not None:
        phases = phases - expected.phases
    of = (torch.tensor(own, dtype=torch.int32) for own in (planes.of_channels, planes.of_pairs))
    inputs = planes.powers, planes.pairs, phases, expected.noise, samples, *of
    new_pass = passes_for("auto", {"powers": planes.powers, "samples": samples})
    nats, failed = StackNats(expected, level, window).on(new_pass, *inputs)
    refuse_failed(int(failed))
    return nats


class StackNats(Operation):
    """`windowed_nats` and how many covariances have none; on engines, value and gradients in one go."""

    operation = "stack_likelihood"
    names = ("power", "pair", "phases", "noise", "truth", "of_channels", "of_pairs")
    optional = ("phases",)
    at_once = True
    constant = (1,)

    def __init__(self, expected: ExpectedStacks, level: Float[Tensor, "v p rows columns"], window: int) -> None:
        self.expected, self.level, self.window = expected, level, window

    def plain(self, *inputs: Tensor) -> tuple[Float[Tensor, ""], int]:
        (*_, noise, samples, _, _), expected = inputs, self.expected
        mean = windowed(expected.planes.whole(expected.phases), self.level, self.window)
        floor = torch.diag_embed(noise).to(mean.dtype)[..., None, None]
        return covariance_nats(mean + floor, unpacked(samples, self.level.shape[1])), 0

    def numbers(self, power: Tensor, pair: Tensor, phases: Tensor, *_: Tensor) -> dict[str, int]:
        names = ("views", "powers", "rows", "columns")
        sizes = dict(zip(names, power.shape, strict=True))
        return sizes | {"passes": phases.shape[1], "pairs": pair.shape[1] // 2, "reach": self.window // 2}

    def outputs(self, power: Tensor, *_: Tensor) -> dict[str, Tensor]:
        return {"loss": power.new_empty(()), "failed": torch.zeros((), dtype=torch.int64)}
