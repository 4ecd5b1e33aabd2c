"""Views of a step a few at a time: the same loss and gradients as all at once, decided by sizes alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from made import box_dataset
from made_runs import assert_same, trained
from sarsplat import Config, Dataset, ImageGrid, preset
from sarsplat.geometry import RayGrid
from sarsplat.learning import Trainer, batching
from sarsplat.learning.batching import in_groups
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info
from sarsplat.settings.sections import Densification

GRID = ImageGrid(24, 24, (0.3, 0.3), (0.4, 0.4))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return box_dataset(tmp_path_factory.mktemp("few"), GRID)


def config(**changes: object) -> Config:
    return replace(preset("default"), iterations=12, gaussians=200, coarsest=1, views_per_step=3, **changes)


def compared(dataset: Dataset, how: Config) -> tuple[torch.Tensor, list[torch.Tensor], Info]:
    trainer = Trainer(dataset, how)
    loss, total, rendering = trainer._losses([0, 2, 1], 1, 1)
    total.backward()
    others = trainer._rays, trainer._bounds, torch.Generator()
    info = Info(trainer.model, trainer.images, (0, 2, 1), rendering, 0, *others)
    return loss, [tensor.grad for tensor in trainer.model.parameters.values()], info


def same(one: torch.Tensor, whole: torch.Tensor) -> None:
    torch.testing.assert_close(one.detach(), whole.detach(), rtol=1e-3, atol=1e-5 * float(whole.detach().abs().max()))


@pytest.mark.parametrize("changes", [{}, {"loss": "speckle", "total_power": 0.05}, {"densification": Densification()}])
def test_they_have_the_loss_and_the_gradients_of_all_at_once(dataset, monkeypatch, changes):
    loss, gradients, at_once = compared(dataset, config(**changes))
    expected = at_once.errors(), at_once.cross_sections()
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    few_loss, few_gradients, few = compared(dataset, config(**changes))
    torch.testing.assert_close(few_loss, loss)
    for one, whole in zip((*few_gradients, few.errors(), few.cross_sections()), (*gradients, *expected), strict=True):
        same(one, whole)
    for name in ("images", "cross_sections", "lit_area"):
        same(getattr(few.rendering, name), getattr(at_once.rendering, name))
    slopes, of_whole = few.rendering.plane_gradients, at_once.rendering.plane_gradients
    assert (slopes is not None) == (of_whole is not None) == ("densification" in changes)
    if slopes is not None and of_whole is not None:
        same(slopes, of_whole)


def test_a_training_is_the_same_for_any_number_of_threads_and_where_it_goes_on(dataset, monkeypatch, threads):
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)

    def resumed(stop: int) -> Snapshot:
        snapshot = trained(dataset, config(), stop).snapshot(0.0)
        threads(3 if torch.get_num_threads() == 1 else 1)
        return trained(dataset, config(), 12 - stop, snapshot).snapshot(0.0)

    assert_same(resumed(5), resumed(9))


def test_how_many_follows_from_sizes():
    grid = ImageGrid(2048, 2048, (0.3, 0.3), (0.3, 0.3))
    rays = RayGrid.for_image(grid)

    def groups(count: int, views: int = 5, most: int = 4) -> list[slice]:
        return in_groups(views, most, {"means": torch.empty(count, 3), "law": torch.empty(1, 3)}, grid, rays)

    assert groups(10_000) == [slice(0, 4), slice(4, 5)]
    assert groups(10_000, 3, 3) == [slice(0, 3)]
    assert groups(1_000_000) == [slice(0, 2), slice(2, 4), slice(4, 5)]
    assert groups(20_000_000) == [slice(k, k + 1) for k in range(5)]


def test_a_loss_of_ones_own_sees_all_views_of_a_step(dataset, monkeypatch):
    """It need not be a mean over them."""
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    seen: list[int] = []

    def loss(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        seen.append(len(rendered))
        return (rendered - truth).square().sum().sqrt()

    Trainer(dataset, config(), loss=loss).step()
    assert seen == [3, 3]  # black images, and those of the step


def test_sampling_in_pieces_draws_the_same(dataset, monkeypatch):
    from sarsplat.gaussians import initialise

    region = initialise.bounded_region(dataset.images("train"), dataset.select("train").views, GRID)
    whole = region.sample(1000, torch.Generator().manual_seed(0))
    monkeypatch.setattr(initialise, "_BATCH", 300)
    assert (region.sample(1000, torch.Generator().manual_seed(0)) == whole).all()
