"""How surprising the signals of stacks are: the likelihood of speckle, of all channels together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Float32, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, shown
from sarsplat.reconstruction import adam
from sarsplat.renderer import cpu, structs
from sarsplat.renderer.once import differentiable_once
from sarsplat.renderer.planes import Planes

_MOST_CHANNELS = 16
"""That the engine takes."""


@checks_arguments
def stack_nats(
    covariances: Complex[Tensor, "v p p rows columns"],
    signals: Complex[Tensor, "v p rows columns"] | Complex[Tensor, "v p p rows columns"],
    noise: float | Float[Tensor, " p"],
) -> Float[Tensor, ""]:
    """Negative logarithm of the likelihood of signals, mean per pixel, nats; without the constant P log π.

    The signals y of a pixel are circular Gaussian with the covariance C, y^H C⁻¹ y + log det C; sample covariances Y of
    L looks are complex Wishart, L (tr C⁻¹Y + log det C), here for one look. For one pass it is log S + I/S, the speckle
    likelihood of power.

    Parameters
    ----------
    covariances : Tensor [V, P, P, rows, columns], complex
        Expected, as `render_covariances` returns; differentiable once.
    signals : Tensor [V, P, rows, columns] or [V, P, P, rows, columns], complex
        Of one look; or sample covariances, means of y_i y_j* over looks.
    noise : float or Tensor [P]
        Power of each pass's noise, β⁰, which is added to the diagonal; positive. In float32, gradients are good to
        2·10⁻⁴ where it is 30 dB below what is brightest, and 70 dB below there is no solution.

    Returns
    -------
    Tensor []
        Nats per pixel.

    Raises
    ------
    SarsplatError
        If shapes or dtypes do not fit, the noise is not positive, or a covariance with noise has no solution.
    """
    passes = covariances.shape[1]
    single = signals.ndim == 4
    wanted = (*covariances.shape[:1], *((passes,) if single else (passes, passes)), *covariances.shape[3:])
    if covariances.shape[2] != passes or tuple(signals.shape) != wanted or signals.dtype != covariances.dtype:
        raise SarsplatError(
            f"signals is {signals.dtype} {tuple(signals.shape)}; for covariances {tuple(covariances.shape)} of "
            f"{covariances.dtype} give {covariances.dtype} {wanted}"
        )
    floor = torch.as_tensor(noise, dtype=covariances.real.dtype, device=covariances.device).expand(passes)
    if not bool((floor > 0).all()):
        raise SarsplatError(
            f"noise is {shown(noise)}; give a positive power, such as a thousandth of what is brightest"
        )
    matrices = covariances.permute(0, 3, 4, 1, 2) + torch.diag(floor).to(covariances.dtype)
    if single:
        signals = signals[:, :, None] * signals[:, None].conj()
    return covariance_nats(matrices.permute(0, 3, 4, 1, 2), signals)


def covariance_nats(
    covariances: Complex[Tensor, "v p p rows columns"], samples: Complex[Tensor, "v p p rows columns"]
) -> Float[Tensor, ""]:
    """`stack_nats` of sample covariances, given covariances that have their noise."""
    nats: Float[Tensor, ""] = _Nats.apply(covariances.permute(0, 3, 4, 1, 2), samples.permute(0, 3, 4, 1, 2))
    return nats


class _Nats(torch.autograd.Function):
    """Mean of tr C⁻¹Y + log det C; its gradient C⁻¹ − C⁻¹YC⁻¹ is a by-product. Differentiable once, in C."""

    @staticmethod
    def forward(
        ctx: Any, matrices: Complex[Tensor, "v r c p p"], samples: Complex[Tensor, "v r c p p"]
    ) -> Float[Tensor, ""]:
        factor, failed = torch.linalg.cholesky_ex(matrices)
        _refuse_failed(int((failed > 0).sum()))
        inverse = torch.cholesky_inverse(factor)
        fitted = inverse @ samples
        surprise, half = (torch.diagonal(of, dim1=-2, dim2=-1).real for of in (fitted, factor))
        ctx.save_for_backward(inverse - fitted @ inverse)
        ctx.pixels = surprise[..., 0].numel()
        nats = surprise.sum(-1) + 2 * half.log().sum(-1)
        return nats.mean(2).mean(1).mean(0)  # one after the other: bits must not depend on threads

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * (slope / ctx.pixels), None


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
        _refuse_failed(int(failed))
        ctx.save_for_backward(*learned)
        return value

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return *(None if of is None else of * slope for of in ctx.saved_tensors), None, None, None, None


def _refuse_failed(count: int) -> None:
    if count:
        raise SarsplatError(
            f"{count} covariances with their noise are not positive definite; raise the noise, or use float64"
        )
