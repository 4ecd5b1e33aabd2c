"""Likelihood of stacks: circular Gaussian speckle of all channels together, of pixels or averaged over windows."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, shown
from sarsplat.renderer.covariances import Planes
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.operation import Operation, differentiable_once


@checks_arguments
def stack_nats(
    covariances: Complex[Tensor, "v p p rows columns"],
    signals: Complex[Tensor, "v p rows columns"] | Complex[Tensor, "v p p rows columns"],
    noise: float | Float[Tensor, " p"],
) -> Float[Tensor, ""]:
    """Negative log-likelihood of signals, mean per pixel, nats; without the constant P log π.

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
        2·10⁻⁴ at 30 dB below the brightest pixel, and there is no solution at 70 dB below.

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
    expected = (*covariances.shape[:1], *((passes,) if single else (passes, passes)), *covariances.shape[3:])
    if covariances.shape[2] != passes or tuple(signals.shape) != expected or signals.dtype != covariances.dtype:
        raise SarsplatError(
            f"signals is {signals.dtype} {tuple(signals.shape)}; for covariances {tuple(covariances.shape)} of "
            f"{covariances.dtype} give {covariances.dtype} {expected}"
        )
    floor = torch.as_tensor(noise, dtype=covariances.real.dtype, device=covariances.device).expand(passes)
    if not bool((floor > 0).all()):
        raise SarsplatError(
            f"noise is {shown(noise)}; give a positive power, such as a thousandth of the brightest pixel's"
        )
    matrices = covariances.permute(0, 3, 4, 1, 2) + torch.diag(floor).to(covariances.dtype)
    if single:
        signals = signals[:, :, None] * signals[:, None].conj()
    return covariance_nats(matrices.permute(0, 3, 4, 1, 2), signals)


def covariance_nats(
    covariances: Complex[Tensor, "v p p rows columns"], samples: Complex[Tensor, "v p p rows columns"]
) -> Float[Tensor, ""]:
    """`stack_nats` of sample covariances; `covariances` include noise."""
    nats: Float[Tensor, ""] = _Nats.apply(covariances.permute(0, 3, 4, 1, 2), samples.permute(0, 3, 4, 1, 2))
    return nats


class _Nats(torch.autograd.Function):
    """Mean of tr C⁻¹Y + log det C; its gradient C⁻¹ − C⁻¹YC⁻¹ is a by-product. Differentiable once, in C."""

    @staticmethod
    def forward(
        ctx: Any, matrices: Complex[Tensor, "v r c p p"], samples: Complex[Tensor, "v r c p p"]
    ) -> Float[Tensor, ""]:
        factor, failed = torch.linalg.cholesky_ex(matrices)
        refuse_failed(int((failed > 0).sum()))
        inverse = torch.cholesky_inverse(factor)
        fitted = inverse @ samples
        trace, roots = (torch.diagonal(matrix, dim1=-2, dim2=-1).real for matrix in (fitted, factor))
        ctx.save_for_backward(inverse - fitted @ inverse)
        ctx.pixels = trace[..., 0].numel()
        nats = trace.sum(-1) + 2 * roots.log().sum(-1)
        return nats.mean(2).mean(1).mean(0)  # one by one: bits must not depend on threads

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * (slope / ctx.pixels), None


def refuse_failed(count: int) -> None:
    """Raise if any covariances, `count`, were not positive definite."""
    if count:
        raise SarsplatError(
            f"{count} covariances with their noise are not positive definite; raise the noise, or use float64"
        )


@dataclass(frozen=True)
class ExpectedStacks:
    """Expected stacks: covariances, noise power of each channel, and additional phases, rad."""

    planes: Planes
    noise: Float[Tensor, "v p"] | None
    phases: Float[Tensor, "v p rows columns"] | None

    def whole(self) -> Complex[Tensor, "v p p rows columns"]:
        """Covariances as Hermitian matrices, with noise and phases."""
        covariances = self.planes.whole(self.phases)
        if self.noise is None:
            return covariances
        noise = self.noise.expand(covariances.shape[:2])
        return covariances + torch.diag_embed(noise).to(covariances.dtype)[..., None, None]


def windowed(
    covariances: Complex[Tensor, "v p p rows columns"], level: Float[Tensor, "v p rows columns"], window: int
) -> Complex[Tensor, "v p p rows columns"]:
    """Deramp covariances by the phases of level ground, rad, and average them over the window around each pixel."""
    phasors = torch.polar(torch.ones_like(level), -level)
    deramped = covariances * (phasors[:, :, None] * phasors[:, None].conj())
    parts = torch.view_as_real(deramped).movedim(-1, 3).flatten(0, 3)
    mean = avg_pool2d(parts[:, None], window, 1, window // 2, count_include_pad=False)[:, 0]
    v, p = covariances.shape[:2]
    return torch.view_as_complex(mean.unflatten(0, (v, p, p, 2)).movedim(3, -1).contiguous())


def packed(covariances: Complex[Tensor, "v p p rows columns"]) -> Float[Tensor, "v q rows columns"]:
    """Pack Hermitian matrices into P² numbers: the diagonal, then real and imaginary parts for each i < j."""
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
    """`stack_nats` of `packed` samples that were `windowed`; windows the expected covariances, then adds noise.

    float32 on the CPU is one call of the engine, anything else plain torch.
    """
    planes = expected.planes
    assert expected.noise is not None
    phases = level - planes.turns[..., None]
    if expected.phases is not None:
        phases = phases - expected.phases
    indices = (torch.tensor(each, dtype=torch.int32) for each in (planes.of_channels, planes.of_pairs))
    inputs = planes.powers, planes.pairs, phases, expected.noise, samples, *indices
    new_pass = passes_for("auto", {"powers": planes.powers, "samples": samples})
    nats, failed = StackNats(expected, level, window).on(new_pass, *inputs)
    refuse_failed(int(failed))
    return nats


class StackNats(Operation):
    """`windowed_nats` and the number of singular covariances; engines compute value and gradients in one call."""

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
