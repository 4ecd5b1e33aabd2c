"""Idle Gaussians join strong ones: who moves, where to, and that little of the image changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from made_runs import trained
from sarsplat import Dataset, preset
from sarsplat.learning.strategies import State, ops
from sarsplat.learning.strategies.relocation import Relocating, pairs
from sarsplat.settings.sections import Relocation


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_rounds_are_evenly_spaced_until_the_last() -> None:
    def rounds(**settings: float) -> list[int]:
        relocating = Relocating(Relocation(**settings), 100)
        return [step for step in range(101) if relocating.due(step)]

    assert rounds(rounds=5, until=0.5) == [10, 20, 30, 40, 50]
    assert rounds(until=0) == []
    assert rounds(rounds=100_000_000, until=1) == list(range(1, 101))


def test_the_weakest_join_strong_ones_each_its_own() -> None:
    sigma = torch.tensor([5.0, 0.0, 3.0, 0.01, 2.0, 0.5])
    idle, strong = pairs(sigma, 0.01, generator())
    assert idle.tolist() == [1, 3]  # 0.01 of 10.51 is less than a hundredth, 0.51 is more
    assert len(set(strong.tolist())) == 2
    assert not set(strong.tolist()) & {1, 3}


def test_at_most_half_is_idle_and_nobody_joins_what_scatters_nothing() -> None:
    assert len(pairs(torch.ones(10), 1.0, generator())[0]) == 5
    idle, strong = pairs(torch.tensor([0.0, 0.0, 0.0, 1.0]), 0.5, generator())
    assert (len(idle), strong.tolist()) == (1, [3])
    assert len(pairs(torch.zeros(4), 0.5, generator())[0]) == 0


def test_a_corner_reflector_leaves_the_others_at_work() -> None:
    sigma = torch.linspace(0.5, 1.5, 1000)
    sigma[:10] = 1e5
    idle, _ = pairs(sigma, 0.01, generator())
    assert len(idle) < 50  # what holds a hundredth of powers that count as no more than 125
    assert pairs(sigma / 1e3, 0.01, generator())[0].tolist() == idle.tolist()


def test_a_round_keeps_the_number_and_about_the_power(dataset: Dataset) -> None:
    config = replace(preset("default"), iterations=80, gaussians=400, relocation=Relocation(rounds=1))
    trainer = trained(dataset, config, 69)
    images, rendering = trainer.model.render(trainer.views, trainer.grid, 0)
    before, means = images.detach(), trainer.gaussians.means.clone()
    rows = pairs(rendering.cross_sections[..., 0].detach().mean(0), 0.01, generator())
    ops.relocate(trainer.model.parameters, trainer.optimiser, State(), *rows, generator())
    assert trainer.optimiser.take_moves() is not None
    after = trainer.model.render(trainer.views, trainer.grid, 0)[0].detach()
    assert len(trainer.model) == 400
    assert 5 < int((trainer.gaussians.means != means).any(dim=1).sum()) < 300
    assert float(after.mean()) == pytest.approx(float(before.mean()), rel=0.25)  # halves that hid each other are seen
    trainer.step()
