"""The likelihood of stacks against closed forms, and the engine's windowed one against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat import SarsplatError, stack_nats
from sarsplat.learning.stack_loss import ExpectedStacks, packed, windowed, windowed_nats
from sarsplat.renderer.covariances import Planes

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


CASES = {  # passes, planes of pairs, window, rows, columns
    "one pass": (1, 0, 1, 5, 7),
    "two, one row": (2, 1, 3, 1, 20),
    "three of which pairs share": (3, 2, 3, 17, 33),
    "a window larger than the image": (4, 6, 9, 8, 5),
    "eight even": (8, 7, 3, 20, 19),
    "as many as the engine takes": (16, 40, 7, 6, 40),
    "more than that": (17, 5, 3, 4, 5),
}


def made(
    passes: int, pairs: int, window: int, rows: int, columns: int
) -> tuple[ExpectedStacks, torch.Tensor, torch.Tensor]:
    """What is expected, float32 leaves; phases to be taken out; and packed samples."""
    g, views = torch.Generator().manual_seed(passes), 2
    size = (rows, columns)
    powers = 1 + torch.rand(views, 1, *size, generator=g)
    between = 0.3 / passes * torch.randn(views, 2 * pairs, *size, generator=g)
    noise = 0.5 + torch.rand(views, passes, generator=g)
    screens = 0.5 * torch.randn(views, passes, *size, generator=g)
    level = 3 * torch.randn(views, passes, *size, generator=g)
    count = passes * (passes - 1) // 2
    of_pairs = tuple(np.random.default_rng(0).integers(0, pairs, count).tolist()) if count else ()
    turns = 0.3 * torch.randn(views, passes, rows, generator=g)
    planes = Planes(powers.requires_grad_(), between.requires_grad_(), (0,) * passes, of_pairs, turns)
    y = torch.randn(views, passes, passes + 2, *size, dtype=torch.complex64, generator=g)
    samples = torch.einsum("vikrc,vjkrc->vijrc", y, y.conj()) / (passes + 2)
    return (
        ExpectedStacks(planes, noise.requires_grad_(), screens.requires_grad_()),
        level,
        packed(windowed(samples, level, window)),
    )


def leaves(expected: ExpectedStacks) -> list[torch.Tensor]:
    return [expected.planes.powers, expected.planes.pairs, expected.noise, expected.phases]


def in_double(expected: ExpectedStacks) -> ExpectedStacks:
    powers, pairs, noise, phases = (leaf.detach().double().requires_grad_() for leaf in leaves(expected))
    planes = replace(expected.planes, powers=powers, pairs=pairs, turns=expected.planes.turns.double())
    return ExpectedStacks(planes, noise, phases)


@pytest.mark.parametrize("case", CASES)
def test_value_and_gradients_are_those_of_plain_torch(case):
    expected, level, samples = made(*CASES[case])
    window, double = CASES[case][2], in_double(expected)
    values, gradients = [], []
    for each, *others in ((expected, level, samples), (double, level.double(), samples.double())):
        value = windowed_nats(each, *others, window=window)
        values.append(value.item())
        found = torch.autograd.grad(1.7 * value, leaves(each), allow_unused=True)
        gradients.append([torch.zeros(1) if one is None else one for one in found])
    assert values[0] == pytest.approx(values[1], rel=2e-6)
    for own, true in zip(*gradients, strict=True):
        assert float((own - true).norm()) <= 3e-6 * float(true.norm()) + 1e-9


def test_threads_change_nothing(threads):
    found = []
    for count in (1, 3):
        threads(count)
        expected, level, samples = made(4, 3, 3, 60, 70)
        value = windowed_nats(expected, level, samples, 3)
        found.append([value.detach(), *torch.autograd.grad(value, leaves(expected))])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_phases_that_are_not_learned_have_no_gradient():
    expected, level, samples = made(3, 3, 3, 6, 6)
    fixed = replace(expected, phases=None)
    gradients = torch.autograd.grad(windowed_nats(fixed, level, samples, 3), leaves(fixed)[:3])
    assert all(bool(gradient.abs().sum() > 0) for gradient in gradients)
    with pytest.raises(SarsplatError, match="no second derivatives"):
        torch.autograd.grad(windowed_nats(fixed, level, samples, 3), leaves(fixed)[:1], create_graph=True)


def test_covariances_that_are_none_are_refused():
    expected, level, samples = made(3, 3, 1, 6, 6)
    planes = replace(expected.planes, pairs=10 + expected.planes.pairs)
    with pytest.raises(SarsplatError, match="72 covariances with their noise are not positive definite"):
        windowed_nats(replace(expected, planes=planes), level, samples, 1)
