"""Density control: who is cloned, split and pruned, and that moments follow their Gaussians."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sarsplat import Gaussians, Harmonics, ImageGrid, SarsplatError, preset
from sarsplat.reconstruction.config import Densification
from sarsplat.reconstruction.density import DensityControl
from sarsplat.reconstruction.optimiser import Optimiser, decay, learning_rate

CONTROL = Densification(
    start=10, stop=100, every=10, gradient=1.0, split_above=0.1, max_extent=0.3, min_scattering=0.01, max_gaussians=10
)

GRID = ImageGrid(10, 8, (0.5, 1.0), (1.0, 1.0))  # cells of 1 m, 10 m in range


def five() -> Gaussians:
    """Steep and small, steep and large, flat, black, far too large."""
    scales = torch.tensor([0.05, 0.2, 0.05, 0.05, 5.0])[:, None].expand(5, 3)
    return Gaussians(
        means=torch.arange(15.0).view(5, 3),
        quaternions=torch.tensor([1.0, 0, 0, 0]).expand(5, 4),
        scales=scales,
        optical_depth=torch.tensor([1.0, 1.0, 1.0, 1e-4, 1.0]),
        scattering=Harmonics(torch.ones(5, 1)),
    )


def test_small_ones_are_cloned_large_ones_split_and_dark_or_huge_ones_pruned() -> None:
    density = DensityControl(CONTROL, 5)
    density.gradient, density.seen = torch.tensor([4.0, 4.0, 1.0, 9.0, 9.0]), torch.full((5,), 2.0)
    source, kept, displacement, shrink = density.decide(five(), GRID, torch.Generator().manual_seed(0))
    assert source.tolist() == [0, 2, 0, 1, 1]
    assert kept.tolist() == [True, True, False, False, False]
    assert displacement[:3].abs().max() == 0
    assert (displacement[3:].norm(dim=1) > 0).all()
    assert shrink.tolist()[:3] == [1.0, 1.0, 1.0]
    assert (shrink[3:] < 1).all()
    assert len(density.gradient) == 5
    assert density.gradient.max() == 0


def test_room_is_given_to_the_steepest() -> None:
    density = DensityControl(replace(CONTROL, max_gaussians=6), 5)
    density.gradient, density.seen = torch.tensor([8.0, 4.0, 6.0, 0.0, 0.0]), torch.full((5,), 2.0)
    source, *_ = density.decide(five(), GRID, torch.Generator().manual_seed(0))
    assert source.tolist() == [0, 1, 2, 0]


def test_the_last_one_is_not_pruned() -> None:
    density = DensityControl(replace(CONTROL, min_scattering=1e6), 5)
    with pytest.raises(SarsplatError, match=r"would remove all Gaussians: none scatters at least 1e\+06"):
        density.decide(five(), GRID, torch.Generator().manual_seed(0))


def test_it_acts_on_schedule() -> None:
    density = DensityControl(CONTROL, 5)
    assert [i for i in range(0, 130, 5) if density.due(i)] == [10, 20, 30, 40, 50, 60, 70, 80, 90]


def test_moments_follow_their_gaussians() -> None:
    config = preset("default")
    old = {"means": torch.zeros(3, 3, requires_grad=True)}
    optimiser = Optimiser(old, {}, config, 1.0)
    (old["means"] * torch.tensor([[1.0], [2.0], [3.0]])).sum().backward()
    optimiser.step(0)
    moments = optimiser.state()["means/exp_avg"].clone()
    new = {"means": torch.zeros(4, 3, requires_grad=True)}
    moved = optimiser.rebuild(new, torch.tensor([2, 0, -1, -1])).state()["means/exp_avg"]
    assert torch.equal(moved, torch.stack([moments[2], moments[0], torch.zeros(3), torch.zeros(3)]))


def test_rates_decay_as_documented() -> None:
    config = preset("default")
    rates, last = config.rates, config.iterations
    assert [learning_rate("scattering", k, config, 2.0) for k in (0, 1)] == [
        rates.scattering,
        rates.directional_scattering,
    ]
    assert learning_rate("scales", 2, config, 2.0) == rates.log_scales
    assert learning_rate("noise", 0, config, 2.0) == rates.nuisance
    assert learning_rate("means", 0, config, 2.0) == 2 * rates.means
    assert learning_rate("shift", 0, config, 2.0) == 2 * rates.shift
    assert decay("means", 0, config) == decay("scattering", last // 2, config) == 1.0
    assert abs(rates.means * decay("means", last, config) - rates.means_end) < 1e-12
    assert abs(decay("shift", last, config) - 0.1) < 1e-12
