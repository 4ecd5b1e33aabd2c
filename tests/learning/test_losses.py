"""Losses and likelihoods against closed forms and an independent SSIM; engines and plain torch against float64."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from emulated_cuda import Emulator

from sarsplat import SarsplatError, preset, stack_nats
from sarsplat.learning import losses
from sarsplat.learning.losses import amplitude_loss, named_loss, speckle_loss, structural_similarity
from sarsplat.learning.stack_loss import ExpectedStacks, packed, windowed, windowed_nats
from sarsplat.renderer.covariances import Planes
from sarsplat.renderer.engines import cpu, cuda

AVAILABLE = cpu.instruction_sets()


def pair(views: int, rows: int, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Power with dark places, and a truth that resembles it."""
    generator = torch.Generator().manual_seed(rows)
    power = 3.0 * torch.rand(views, rows, columns, generator=generator) ** 3
    power[:, ::3] *= 1e-4
    truth = (power.sqrt() / 2.0 + 0.1 * torch.randn(power.shape, generator=generator)).clamp(min=0)
    power.clamp_(min=1e-6)  # below, float32 cannot tell on which side of a truth of 0 the softened amplitude lies
    power[0, 0, 0], truth[0, 0, 0] = 0.0, 0.3
    return power, 4.0 * truth**2


# one vector and less, tails, a window that fits once, more rows than one task, tasks shorter than the window
@pytest.mark.parametrize("shape", [(1, 11, 11), (2, 12, 29), (3, 40, 17), (1, 130, 128), (2, 33, 64)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("how", [*AVAILABLE, "cuda", "plain"])
def test_amplitude_loss_and_its_gradient_are_those_of_float64(shape, weight, how, request, monkeypatch) -> None:
    new_pass = None if how == "plain" else partial(cpu.Pass, how)
    if how == "cuda":
        new_pass = partial(cuda.Pass, Emulator(request.getfixturevalue("library")))
    monkeypatch.setattr(losses, "passes_for", lambda *_: new_pass)
    power, truth = pair(*shape)
    mine, theirs = power.clone().requires_grad_(), power.double().requires_grad_()
    actual = amplitude_loss(mine, truth, 2.0, weight)
    expected = losses.AmplitudeLoss(2.0, weight).plain(theirs, truth.double())
    assert float(actual.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    (3.0 * actual).backward()
    (3.0 * expected).backward()
    assert float(theirs.grad.norm()) > 0
    assert float((mine.grad - theirs.grad).norm() / theirs.grad.norm()) < 1e-5


def test_the_slope_is_finite_at_zero_also_in_images_smaller_than_the_window_without_ssim() -> None:
    power = torch.zeros(1, 4, 4, requires_grad=True)
    amplitude_loss(power, torch.ones(1, 4, 4), 5.0, 0.0).backward()
    assert bool(torch.isfinite(power.grad).all())


def test_a_perfect_image_costs_nothing() -> None:
    truth = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(2))
    power = (truth + 1e-3) ** 2 - 1e-6  # whose softened amplitude is the truth
    assert float(amplitude_loss(power, truth**2, 1.0, 0.2)) == pytest.approx(0.0, abs=1e-5)


def test_it_takes_float64_as_it_is() -> None:
    power, truth = (tensor[:1, :12, :13].double() for tensor in pair(1, 40, 40))
    power = power.clamp(min=0.1).requires_grad_()  # the root is too steep near 0 for finite differences
    assert torch.autograd.gradcheck(lambda power: amplitude_loss(power, truth, 2.0, 0.3), power, fast_mode=True)


@pytest.mark.parametrize("size", [(40, 48), (12, 11)])
def test_ssim_is_an_independent_one_where_the_window_fits_whole(size) -> None:
    metrics = pytest.importorskip("torchmetrics.functional.image")
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(2, *size, generator=generator, dtype=torch.float64)
    a[:, :, :9] *= 0.05  # dark and flat, where the constants count
    b = (a + 0.1 * torch.randn(a.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    _, maps = metrics.structural_similarity_index_measure(
        a[:, None], b[:, None], sigma=1.5, data_range=1.0, return_full_image=True
    )
    assert float(structural_similarity(a, b)) == pytest.approx(float(maps[..., 5:-5, 5:-5].mean()), abs=1e-6)
    assert float(structural_similarity(a, a)) == pytest.approx(1.0, abs=1e-12)


def test_speckle_likelihood_is_best_at_the_mean_intensity() -> None:
    intensity = -torch.log(torch.rand(1, 64, 64, generator=torch.Generator().manual_seed(0))) * 3.0
    levels = torch.linspace(1.0, 6.0, 51)
    losses = torch.stack([speckle_loss(torch.full_like(intensity, float(level)), intensity) for level in levels])
    assert float(levels[losses.argmin()]) == pytest.approx(float(intensity.mean()), abs=0.06)


@pytest.mark.parametrize("name", ["speckled", "scene", "measured"])
def test_speckle_has_a_bounded_likelihood_where_images_are_black(name) -> None:
    power, _ = pair(2, 20, 20)
    power[:, :, ::4] = 0.0
    rendered = torch.where(power > power.median(), power, 0.0).requires_grad_()
    loss = named_loss(replace(preset(name), total_power=0.0), float(power.max()), 1.0)
    value = loss(rendered, power)
    value.backward()
    slope = rendered.grad / rendered.grad.abs().max()
    assert (slope < 0)[(rendered == 0) & (power > 0)].all()  # what is missing is asked for
    assert (slope.abs() < 1e-6)[power == 0].all()  # darker shadows are not
    assert value > loss(power, power)


def test_total_power_is_asked_for_of_each_image() -> None:
    truth, _ = pair(2, 20, 20)
    brightest = float(truth.max())
    rendered = truth * torch.tensor([0.5, 2.0])[:, None, None]
    black = torch.zeros_like(truth)

    def cost(*images: torch.Tensor) -> float:
        """What it adds to the likelihood."""
        weighted = [replace(preset("speckled"), total_power=weight) for weight in (0.0, 0.3)]
        of = [named_loss(config, brightest, 1.0)(*images) for config in weighted]
        return float(of[1] - of[0])

    assert cost(rendered, truth) == pytest.approx(0.3 * (2 / 3) ** 2, rel=1e-3)
    assert cost(black, truth) == pytest.approx(0.3 * 4, rel=1e-3)
    assert cost(truth, truth) == cost(black, black) == 0


@pytest.mark.parametrize("name", ["default", "speckled", "measured"])
def test_no_named_loss_depends_on_the_unit_of_power(name) -> None:
    truth, _ = pair(2, 20, 20)
    truth += 0.01
    actual = []
    for unit in (1.0, 1e-6, 1e6):
        loss = named_loss(preset(name), unit * float(truth.max()), unit * float(truth.mean()))
        actual.append(loss(unit * truth.flip(1), unit * truth).item())
    assert actual == pytest.approx([actual[0]] * 3, rel=1e-4)


ONES = torch.ones(1, 4, 4)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: amplitude_loss(ONES, torch.ones(1, 4, 5), 1.0, 0.0), r"truth is torch.float32 \(1, 4, 5\) on cpu; it"),
        (lambda: amplitude_loss(ONES, ONES.double(), 1.0, 0.0), r"truth is torch.float64 .* must be torch.float32 \(1"),
        (lambda: amplitude_loss(*pair(1, 10, 40), 1.0, 0.2), "SSIM needs images of at least 11 × 11 .* these have 10"),
        (lambda: stack_nats(matrices(2), signals(matrices(2), 0.1), 0.0), "give a positive power"),
        (lambda: stack_nats(matrices(2), signals(matrices(2), 0.1), math.nan), "give a positive power"),
        (
            lambda: stack_nats(matrices(2), signals(matrices(2), 0.1).to(torch.complex64), 0.1),
            r"signals is torch.complex64 .* give torch.complex128 \(2, 2, 5, 7\)",
        ),
        (lambda: stack_nats(matrices(2), signals(matrices(2), 0.1)[:, :1], 0.1), r"for covariances \(2, 2, 2, 5, 7\)"),
    ],
)
def test_what_does_not_fit_together_is_refused(call, words) -> None:
    with pytest.raises(SarsplatError, match=words):
        call()


def test_numbers_may_be_tensors_and_none_is_refused() -> None:
    """An engine takes a tensor's value, and not its address."""
    images = torch.rand(2, 2, 16, 16, generator=torch.Generator().manual_seed(3))
    expected = losses.amplitude_loss(images[0], images[1], 1.3, 0.2)
    for numbers in ((torch.tensor(1.3), 0.2), (1.3, torch.tensor(0.2))):
        torch.testing.assert_close(losses.amplitude_loss(images[0], images[1], *numbers), expected)
    with pytest.raises(TypeError):
        losses.amplitude_loss(images[0], images[1], None, 0.2)


# ---- the likelihood of stacks ----------------------------------------------------------------------------------------
ROWS, COLUMNS = 5, 7


def matrices(passes: int) -> torch.Tensor:
    """Covariances of a few scatterers: not of full rank without noise."""
    generator = torch.Generator().manual_seed(0)
    roots = torch.randn(2, ROWS, COLUMNS, passes, 2, generator=generator, dtype=torch.complex128)
    return (roots @ roots.mH).permute(0, 3, 4, 1, 2).contiguous()


def signals(covariances: torch.Tensor, noise: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    passes = covariances.shape[1]
    factor = torch.linalg.cholesky(covariances.permute(0, 3, 4, 1, 2) + noise * torch.eye(passes))
    drawn = torch.randn(*factor.shape[:-1], 1, generator=generator, dtype=torch.complex128)
    return (factor @ drawn)[..., 0].permute(0, 3, 1, 2)


@pytest.mark.parametrize("passes", [1, 3])
def test_it_is_that_of_a_circular_gaussian(passes: int) -> None:
    """Of one pass it is the speckle likelihood of power."""
    c, noise = matrices(passes), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)[:passes]
    y = signals(c, 0.2)
    whole = c.permute(0, 3, 4, 1, 2) + torch.diag(noise)
    vectors = y.permute(0, 2, 3, 1)
    surprise = (vectors.conj() * torch.linalg.solve(whole, vectors)).sum(-1).real
    expected = float((surprise + torch.logdet(whole).real).mean())
    assert float(stack_nats(c, y, noise)) == pytest.approx(expected, rel=1e-12)
    if passes == 1:
        assert float(speckle_loss(c[:, 0, 0].real + 0.1, y[:, 0].abs().square())) == pytest.approx(expected, rel=1e-12)
    sample = torch.einsum("virc,vjrc->vijrc", y, y.conj())
    assert float(stack_nats(c, sample, noise)) == pytest.approx(expected, rel=1e-12)


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
