"""Losses against closed forms and an independent SSIM."""

from __future__ import annotations

import pytest
import torch

from sarsplat.reconstruct.losses import amplitude, amplitude_loss, speckle_loss, ssim


def test_amplitude_is_a_root_with_a_finite_slope_at_zero() -> None:
    power = torch.tensor([0.0, 4.0, 25.0], requires_grad=True)
    root = amplitude(power, 5.0)
    assert torch.allclose(root, torch.tensor([0.0, 0.4, 1.0]), atol=2e-3)
    root.sum().backward()
    assert bool(torch.isfinite(power.grad).all())  # type: ignore[union-attr]


def test_speckle_likelihood_is_best_at_the_mean_intensity() -> None:
    intensity = -torch.log(torch.rand(1, 64, 64, generator=torch.Generator().manual_seed(0))) * 3.0
    levels = torch.linspace(1.0, 6.0, 51)
    losses = torch.stack([speckle_loss(torch.full_like(intensity, float(level)), intensity) for level in levels])
    assert float(levels[losses.argmin()]) == pytest.approx(float(intensity.mean()), abs=0.06)


def test_ssim_agrees_with_an_independent_one() -> None:
    metrics = pytest.importorskip("torchmetrics.functional.image")
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(2, 40, 48, generator=generator)
    b = (a + 0.2 * torch.randn(2, 40, 48, generator=generator)).clamp(0, 1)
    theirs = metrics.structural_similarity_index_measure(
        a[:, None], b[:, None], gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0
    )
    assert float(ssim(a, b)) == pytest.approx(float(theirs), abs=0.02)  # theirs pads the border, ours leaves it out
    assert float(ssim(a, a)) == pytest.approx(1.0, abs=1e-5)


def test_the_loss_mixes_l1_and_ssim() -> None:
    truth = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(2))
    power = (truth + 1e-3) ** 2 - 1e-6  # whose softened amplitude is the truth
    assert float(amplitude_loss(power, truth, 1.0, 0.2)) == pytest.approx(0.0, abs=1e-5)
    other = power + 0.1
    rendered = amplitude(other, 1.0)
    expected = 0.8 * (rendered - truth).abs().mean() + 0.2 * (1 - ssim(rendered, truth))
    assert float(amplitude_loss(other, truth, 1.0, 0.2)) == pytest.approx(float(expected), rel=1e-5)
