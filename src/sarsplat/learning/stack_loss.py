"""Likelihood of the complex signals of stacks: circular Gaussian speckle of all channels together."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, shown
from sarsplat.renderer.engines.operation import differentiable_once


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
        refuse_failed(int((failed > 0).sum()))
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


def refuse_failed(count: int) -> None:
    """Require that all covariances were positive definite: `count` were not."""
    if count:
        raise SarsplatError(
            f"{count} covariances with their noise are not positive definite; raise the noise, or use float64"
        )
