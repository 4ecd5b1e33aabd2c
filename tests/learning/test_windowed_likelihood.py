"""The engine's likelihood of stacks: value and every gradient are those of plain torch in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.learning.stack_loss import ExpectedStacks, packed, windowed, windowed_nats
from sarsplat.renderer.planes import Planes

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
