"""The ground of a model: its level, its texture and its law of the grazing angle are those of the images."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from made import dataset_of, upright
from made_runs import trained
from sarsplat import Dataset, Ground, Trainer, preset, reconstruct
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, Terrain, View
from sarsplat.renderer import render
from sarsplat.settings.sections import FlatGround

GRID = ImageGrid(48, 48, (0.3, 0.3), (0.3, 0.3))
SHORT = replace(preset("default"), iterations=150, gaussians=150, ground=FlatGround())


def block() -> Gaussians:
    """Something opaque of 2 × 1 × 1 m."""
    steps = [np.arange(low, high, 0.2) + 0.1 for low, high in ((-1, 1), (-0.5, 0.5), (0, 1))]
    means = np.stack(np.meshgrid(*steps), -1).reshape(-1, 3)
    return upright(means, 0.1, 2.0, Harmonics(torch.zeros(len(means), 1), 0.3))


def seen(views: list[View], ground: Ground) -> Dataset:
    with torch.no_grad():
        images = render(block(), views, GRID, ground=ground).channel(0).numpy()
    return dataset_of(GRID, [(view, "train") for view in views], images, ground=True)


def test_level_and_law_are_learned() -> None:
    views = [View(60.0 * k, (25.0, 40.0, 60.0)[k % 3]) for k in range(6)]
    dataset = seen(views, Ground(torch.tensor(0.2), exponent=torch.tensor(0.8)))
    trainer = trained(dataset, SHORT, 150)
    ground = trainer.model.ground()
    assert float(ground.exponent.detach()) == pytest.approx(0.8, abs=0.1)
    assert float(ground.gamma0.detach().median()) == pytest.approx(0.2, rel=0.05)
    assert float(trainer.gaussians.means[:, 2].min()) >= 0  # nothing of the target is below the ground


@pytest.mark.parametrize("unit", [1.0, 1e4])
def test_a_run_says_what_it_learned_of_the_ground(unit: float) -> None:
    """In the unit of the images, which chips without calibration choose as they like."""
    views = [View(60.0 * k, (25.0, 40.0, 60.0)[k % 3]) for k in range(6)]
    dataset = seen(views, Ground(torch.tensor(0.2 * unit)))
    facts = reconstruct(dataset, replace(SHORT, iterations=60), quiet=True).facts
    match = re.fullmatch(r"a plane, γ⁰ (\S+) \(linear\)", facts["ground"])
    assert match
    assert float(match[1]) == pytest.approx(0.2 * unit, rel=0.1)


def test_a_run_says_where_it_looked_for_the_target_and_that_its_ground_was_terrain() -> None:
    """What stands outside of the box is not in the result, and nothing else says so."""
    dataset = seen([View(60.0 * k, 35.0) for k in range(6)], Ground(torch.tensor(0.2)))
    dataset = replace(dataset, target_box_m=((-2, -1, 0), (2.5, 1, 2)))
    flat = reconstruct(dataset, replace(SHORT, iterations=1), quiet=True).facts
    assert flat["looked in"] == "x -2 … 2.5, y -1 … 1, z 0 … 2 m (--target-box gives another)"
    hilly = replace(dataset, terrain=Terrain(np.zeros((60, 60), np.float32), (0.5, 0.5)))
    facts = reconstruct(hilly, replace(SHORT, iterations=1), quiet=True).facts
    assert "z 0 … 2 m above the terrain" in facts["looked in"]
    assert facts["ground"].startswith("terrain, γ⁰ ")


def test_texture_is_learned_where_it_is() -> None:
    """Twice as bright where y > 0."""
    table = torch.full((41, 41), 0.1)
    table[21:] = 0.2
    views = [View(60.0 * k, 35.0) for k in range(6)]
    trainer = trained(seen(views, Ground(table, 0.5)), SHORT, 150)
    assert trainer.learning_rates["ground_exponent"] == 0  # one angle says nothing of others
    ground = trainer.model.ground()
    gamma0, middle = ground.gamma0.detach(), (len(ground.gamma0) - 1) // 2
    apart = round(3 / ground.pitch_m)
    assert float(gamma0[middle + apart, middle]) == pytest.approx(0.2, rel=0.1)
    assert float(gamma0[middle - apart, middle]) == pytest.approx(0.1, rel=0.1)


def test_places_are_as_far_apart_as_cells_and_scene_say() -> None:
    dataset = seen([View(60.0 * k, 35.0) for k in range(3)], Ground(torch.tensor(0.2)))
    pitch_m = [
        Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=pitch))).model.ground().pitch_m for pitch in (2.0, 5.0)
    ]
    assert pitch_m == pytest.approx([0.6, 1.5])
    assert Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=0))).model.ground().gamma0.ndim == 0
    radius_m = 12.0  # about
    dense = Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=0.01))).model.ground()
    assert len(dense.gamma0) <= 515
    assert dense.pitch_m == pytest.approx(2 * radius_m / 512, rel=0.2)
