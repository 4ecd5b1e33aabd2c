"""The likelihood of stacks: of one pass that of speckle, least at the truth, with the gradient of its closed form."""

from __future__ import annotations

import math

import pytest
import torch

from sarsplat import SarsplatError, stack_nats

ROWS, COLUMNS = 5, 7


def matrices(passes: int, seed: int = 0, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    """Covariances of a few scatterers: not of full rank without noise."""
    generator = torch.Generator().manual_seed(seed)
    roots = torch.randn(2, ROWS, COLUMNS, passes, 2, generator=generator, dtype=torch.complex128)
    return (roots @ roots.mH).permute(0, 3, 4, 1, 2).contiguous().to(dtype)


def signals(covariances: torch.Tensor, noise: float, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    passes = covariances.shape[1]
    factor = torch.linalg.cholesky(covariances.permute(0, 3, 4, 1, 2) + noise * torch.eye(passes))
    drawn = torch.randn(*factor.shape[:-1], 1, generator=generator, dtype=torch.complex128)
    return (factor @ drawn)[..., 0].permute(0, 3, 1, 2)


def test_one_pass_is_the_speckle_likelihood_of_power() -> None:
    c, noise = matrices(1), 0.1
    y = signals(c, noise)
    power, measured = c[:, 0, 0].real + noise, y[:, 0].abs().square()
    assert float(stack_nats(c, y, noise)) == pytest.approx(float((power.log() + measured / power).mean()), rel=1e-12)


def test_it_is_that_of_a_circular_gaussian() -> None:
    c, noise = matrices(3), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    y = signals(c, 0.2)
    whole = c.permute(0, 3, 4, 1, 2) + torch.diag(noise)
    vectors = y.permute(0, 2, 3, 1)
    surprise = (vectors.conj() * torch.linalg.solve(whole, vectors)).sum(-1).real
    expected = float((surprise + torch.logdet(whole).real).mean())
    assert float(stack_nats(c, y, noise)) == pytest.approx(expected, rel=1e-12)
    sample = torch.einsum("virc,vjrc->vijrc", y, y.conj())
    assert float(stack_nats(c, sample, noise)) == pytest.approx(expected, rel=1e-12)


def test_the_truth_is_least_surprising() -> None:
    c, noise = matrices(3), 0.1
    c = c[:, :, :, :1, :1].expand(-1, -1, -1, 60, 60).contiguous()
    y = signals(c, noise)
    best = stack_nats(c, y, noise)
    for other in (1.3 * c, 0.7 * c, matrices(3, 5)[:, :, :, :1, :1].expand_as(c)):
        assert float(stack_nats(other, y, noise)) > float(best) + 0.02


def test_its_gradient_is_the_closed_form() -> None:
    """G = C⁻¹ − C⁻¹ Y C⁻¹ over the number of pixels, dL = Re tr(G dC)."""
    c, noise = matrices(4).requires_grad_(), 0.05
    y = signals(c.detach(), noise)
    (gradient,) = torch.autograd.grad(stack_nats(c, y, noise), c)
    inverse = torch.linalg.inv(c.detach().permute(0, 3, 4, 1, 2) + noise * torch.eye(4, dtype=torch.float64))
    at = inverse @ y.permute(0, 2, 3, 1)[..., None]
    expected = ((inverse - at @ at.mH) / (2 * ROWS * COLUMNS)).permute(0, 3, 4, 1, 2)
    hermitian = (gradient + gradient.transpose(1, 2).conj()) / 2  # of a Hermitian argument
    assert float((hermitian - expected).norm()) < 1e-10 * float(expected.norm())


def test_float32_is_good_enough_for_noise_of_a_thousandth() -> None:
    c = matrices(8)
    level = float(c.abs().amax())
    y = signals(c, 1e-3 * level)
    gradients = []
    for dtype in (torch.complex128, torch.complex64):
        leaf = c.to(dtype).requires_grad_()
        gradients.append(torch.autograd.grad(stack_nats(leaf, y.to(dtype), 1e-3 * level), leaf)[0].to(torch.complex128))
    assert float((gradients[1] - gradients[0]).norm()) < 2e-4 * float(gradients[0].norm())
    with pytest.raises(SarsplatError, match="not positive definite; raise the noise, or use float64"):
        stack_nats(c.to(torch.complex64), y.to(torch.complex64), 1e-9 * level)


def test_what_is_refused() -> None:
    c = matrices(2)
    y = signals(c, 0.1)
    for noise in (0.0, -1.0, math.nan):
        with pytest.raises(SarsplatError, match=r"noise is .*; give a positive power"):
            stack_nats(c, y, noise)
    with pytest.raises(SarsplatError, match=r"signals is torch.complex64 .* give torch.complex128 \(2, 2, 5, 7\)"):
        stack_nats(c, y.to(torch.complex64), 0.1)
    with pytest.raises(SarsplatError, match=r"\(2, 1, 5, 7\); for covariances \(2, 2, 2, 5, 7\)"):
        stack_nats(c, y[:, :1], 0.1)
