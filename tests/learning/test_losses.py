"""Losses against closed forms and an independent SSIM; the engine's and plain torch's against float64."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from emulated_cuda import Emulator

from sarsplat.errors import SarsplatError
from sarsplat.learning import losses
from sarsplat.learning.losses import ImageScale, amplitude_loss, named_loss, speckle_loss, structural_similarity
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.settings import preset

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


def test_the_slope_is_finite_at_zero() -> None:
    power = torch.zeros(1, 4, 4, requires_grad=True)
    amplitude_loss(power, torch.ones(1, 4, 4), 5.0, 0.0).backward()
    assert bool(torch.isfinite(power.grad).all())


def test_a_perfect_image_costs_nothing() -> None:
    truth = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(2))
    power = (truth + 1e-3) ** 2 - 1e-6  # whose softened amplitude is the truth
    assert float(amplitude_loss(power, truth**2, 1.0, 0.2)) == pytest.approx(0.0, abs=1e-5)


def test_images_smaller_than_the_window() -> None:
    with pytest.raises(SarsplatError, match=r"SSIM needs images of at least 11 × 11 pixels, and these have 10 × 40"):
        amplitude_loss(*pair(1, 10, 40), 1.0, 0.2)
    assert float(amplitude_loss(*pair(1, 10, 40), 1.0, 0.0)) > 0


def test_it_takes_float64_as_it_is() -> None:
    power, truth = (tensor[:1, :12, :13].double() for tensor in pair(1, 40, 40))
    power = power.clamp(min=0.1).requires_grad_()  # the root is too steep near 0 for finite differences
    assert torch.autograd.gradcheck(lambda power: amplitude_loss(power, truth, 2.0, 0.3), power)


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


def test_speckle_of_a_target_alone_has_a_likelihood_where_the_image_is_black_and_in_any_unit() -> None:
    power, _ = pair(2, 20, 20)
    rendered = torch.where(power > power.median(), power, 0.0)
    actual = []
    for unit in (1.0, 1e-6, 1e6):
        loss = named_loss(preset("speckled"), ImageScale(unit * float(power.max()), 1.0))
        image = (unit * rendered).requires_grad_()
        value = loss(image, unit * power)
        value.backward()
        assert (image.grad < 0)[(rendered == 0) & (power > 0)].all()  # what is missing is asked for
        actual.append(value.item())
        assert value > loss(unit * power, unit * power)
    assert actual == pytest.approx([actual[0]] * 3, rel=1e-4)


def test_total_power_is_asked_for_of_each_image() -> None:
    truth, _ = pair(2, 20, 20)
    scale = ImageScale(float(truth.max()), 1.0)
    rendered = truth * torch.tensor([0.5, 2.0])[:, None, None]
    black = torch.zeros_like(truth)

    def cost(*images: torch.Tensor) -> float:
        """What it adds to the likelihood."""
        of = [named_loss(replace(preset("speckled"), total_power=weight), scale)(*images) for weight in (0.0, 0.3)]
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
        loss = named_loss(preset(name), ImageScale(unit * float(truth.max()), unit * float(truth.mean())))
        actual.append(loss(unit * truth.flip(1), unit * truth).item())
    assert actual == pytest.approx([actual[0]] * 3, rel=1e-4)


@pytest.mark.parametrize("wrong", [torch.ones(1, 4, 5), torch.ones(1, 4, 4, dtype=torch.float64)])
def test_what_does_not_fit_together_is_refused(wrong) -> None:
    with pytest.raises(
        SarsplatError, match=r"truth is torch.float\d\d \(1, 4, .\) on cpu; it must be torch.float32 \(1, 4, 4\) on cpu"
    ):
        amplitude_loss(torch.ones(1, 4, 4), wrong, 1.0, 0.0)


def test_numbers_may_be_tensors_and_none_is_refused() -> None:
    """An engine takes a tensor's value, and not its address."""
    images = torch.rand(2, 2, 16, 16, generator=torch.Generator().manual_seed(3))
    expected = losses.amplitude_loss(images[0], images[1], 1.3, 0.2)
    for numbers in ((torch.tensor(1.3), 0.2), (1.3, torch.tensor(0.2))):
        torch.testing.assert_close(losses.amplitude_loss(images[0], images[1], *numbers), expected)
    with pytest.raises(TypeError):
        losses.amplitude_loss(images[0], images[1], None, 0.2)
