"""Density control: who is cloned, split and pruned, and when."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from made import upright
from sarsplat import Gaussians, ImageGrid, SarsplatError
from sarsplat.learning.strategies import State
from sarsplat.learning.strategies.density import DensityControl
from sarsplat.settings.sections import Densification

CONTROL = Densification(
    start=10, stop=100, every=10, gradient=1.0, split_above=0.1, max_extent=0.3, min_scattering=0.01, max_gaussians=10
)

GRID = ImageGrid(10, 8, (0.5, 1.0), (1.0, 1.0))  # cells of 1 m, 10 m in range


def five() -> Gaussians:
    """Steep and small, steep and large, flat, black, far too large."""
    scales = torch.tensor([[0.05], [0.2], [0.05], [0.05], [5.0]])
    return upright(torch.arange(15.0), scales, [1.0, 1.0, 1.0, 1e-4, 1.0])


def gathered(*gradient: float) -> State:
    """Sums over two views."""
    return State({"gradient": torch.tensor(gradient), "seen": torch.full((len(gradient),), 2.0)})


def test_small_ones_are_cloned_large_ones_split_and_dark_or_huge_ones_pruned() -> None:
    pruned, cloned, split = DensityControl(CONTROL).decide(five(), GRID, gathered(4.0, 4.0, 1.0, 9.0, 9.0))
    assert pruned.tolist() == [False, False, False, True, True]
    assert cloned.tolist() == [True, False, False, False, False]
    assert split.tolist() == [False, True, False, False, False]


def test_room_is_given_to_the_steepest() -> None:
    density = DensityControl(replace(CONTROL, max_gaussians=6))
    _, cloned, split = density.decide(five(), GRID, gathered(8.0, 4.0, 6.0, 0.0, 0.0))
    assert (cloned | split).tolist() == [True, False, False, False, False]


def test_the_last_one_is_not_pruned() -> None:
    density = DensityControl(replace(CONTROL, min_scattering=1e6))
    with pytest.raises(SarsplatError, match=r"would remove all Gaussians: none scatters at least 1e\+06"):
        density.decide(five(), GRID, gathered(0.0, 0.0, 0.0, 0.0, 0.0))


def test_it_acts_on_schedule() -> None:
    density = DensityControl(CONTROL)
    assert [i for i in range(0, 130, 5) if density.due(i)] == [10, 20, 30, 40, 50, 60, 70, 80, 90]
