"""What images leave open: the inside of a uniform roof is, and its edges and whatever has texture are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from made import FEW_POINTS, dataset_of
from sarsplat import Gaussians, Harmonics, ImageGrid, Run, View, render
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.left_open import places, undetermined
from sarsplat.learning import batching
from sarsplat.learning.model import SceneModel

GRID = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 60)]
WIDE_M, HEIGHT_M = 10.0, 2.0


def plate(texture: float) -> Gaussians:
    """A level square of thin Gaussians, whose γ⁰ changes by a factor from cell to cell."""
    places = np.stack(np.meshgrid(*[np.arange(-WIDE_M / 2, WIDE_M / 2, 0.15)] * 2), axis=-1).reshape(-1, 2)
    count = len(places)
    chance = np.random.default_rng(0).choice([1.0, texture], (70, 70))
    gamma0 = chance[tuple(((places + WIDE_M / 2) / 0.9).astype(int).T)]
    return Gaussians(
        means=torch.tensor(np.column_stack([places, np.full(count, HEIGHT_M)]), dtype=torch.float32),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.tensor([[0.15, 0.15, 0.02]]).repeat(count, 1),
        optical_depth=torch.full((count,), 2.0),
        scattering=Harmonics(torch.tensor(gamma0[:, None], dtype=torch.float32)),
    )


def run_of(gaussians: Gaussians, noise: float) -> Run:
    images = render(gaussians, VIEWS, GRID).channel(0).numpy() ** 0.5
    images = (images + noise * images.max() * np.random.default_rng(1).normal(size=images.shape)) ** 2
    dataset = dataset_of(GRID, [(view, "train") for view in VIEWS], images.astype(np.float32))
    run = Run.from_gaussians(gaussians, dataset=dataset)
    return replace(run, config=replace(run.config, points=FEW_POINTS))


def shares(texture: float, noise: float = 0.02) -> tuple[float, float]:
    """What is open of the inside, and near the edges."""
    where, left_open = places(run_of(plate(texture), noise))
    to_edge, above = WIDE_M / 2 - np.abs(where[:, :2]).max(axis=1), where[:, 2] > HEIGHT_M - 0.1
    return left_open[above & (to_edge > 2)].mean(), left_open[above & (to_edge < 0.5)].mean()


def test_the_inside_of_a_uniform_roof_is_open_and_its_edges_are_not() -> None:
    inside, edges = shares(texture=1.0)
    assert inside > 0.8
    assert edges < 0.1


def test_texture_determines_unless_noise_hides_it() -> None:
    assert shares(texture=100.0)[0] < 0.2
    assert shares(texture=100.0, noise=2.0)[0] > 0.8


def test_large_views_are_looked_at_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    run, render, views = run_of(plate(1.0), 0.02), SceneModel.render, list[int]()
    usual = places(run)[1]

    def counted(model: SceneModel, some: Sequence[View], *given: Any, **named: Any) -> Any:
        views.append(len(some))
        return render(model, some, *given, **named)

    monkeypatch.setattr(SceneModel, "render", counted)
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    assert np.mean(places(run)[1] == usual) > 0.99
    assert {*views} == {1}


def test_without_images_it_is_not_known() -> None:
    dataset = dataset_of(GRID, [(VIEWS[0], "test")], np.ones((1, 64, 64), np.float32))
    run = run_of(plate(1.0), 0.02)
    with pytest.raises(UndefinedScore, match="no training images"):
        undetermined(replace(run, images=dataset))
