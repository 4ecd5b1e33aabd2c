"""`experiments/measured.py`: what is switched off, what is held back, and what the tables say."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction import preset


@pytest.fixture
def measured(module) -> ModuleType:
    return module("experiments/measured")


def test_every_term_but_the_first_is_one_of_the_preset(measured):
    config = preset("measured")
    everything, *terms = measured.TERMS.values()
    assert measured.changed(config, everything) == config
    for changes in terms:
        without = measured.changed(config, changes)
        for name, value in changes.items():
            owner = without.surroundings if hasattr(without.surroundings, name) else without
            assert getattr(owner, name) == value
        there = [measured.changed(config, {name: value}) != config for name, value in changes.items()]
        assert all(there), f"{changes} changes nothing"


def test_training_chips_alone_are_folded(measured):
    grid = ImageGrid(16, 16, (0.2, 0.2), (0.3, 0.3))
    views = [(View(20.0 * k, 17.0), "test-17" if k in (0, 5) else "train") for k in range(10)]
    images = np.ones((10, 16, 16), np.float32)
    fold = measured.folded(dataset_of(grid, views, images, calibration="relative", looks=1.0, ground=True))
    assert [entry.name for entry in fold.select("test").entries] == ["002", "007"]  # the second and the sixth
    assert [entry.name for entry in fold.select("train").entries] == ["001", "003", "004", "006", "008", "009"]


def test_rows_are_means_over_seeds(measured):
    def scores(value: float) -> dict[str, float]:
        return {key: value + index for index, key in enumerate(measured.SCORES)}

    assert measured.row("nearest", [scores(0.5)]) == "| nearest | 0.500 | 1.500 | 2.500 | 3.500 |"
    two = measured.row("ours", [scores(0.5), scores(0.7)])
    assert two.startswith("| ours | 0.600 ± 0.1414 | 1.600 ± 0.1414 |")
    lines = measured.table("", [two]).splitlines()
    assert [line.count("|") for line in lines] == [6, 6, 6]
    assert lines[0].startswith("|  | registered nats ↓ | registered correlation ↑ | plain nats ↓ |")


def test_shape_is_that_of_the_training_views_against_the_targets_model(measured, monkeypatch, tmp_path):
    asked = []

    def scores(dataset, config, name, mesh):
        asked.append((name, len(dataset.select("train")), len(dataset), mesh.name, config.seed))
        return {"points": {"visible": dict.fromkeys(measured.SHAPE, float(config.seed))}}

    monkeypatch.setattr(measured, "scores", scores)
    monkeypatch.setattr(measured, "WORK", tmp_path)
    (tmp_path / "datasets").mkdir()
    grid = ImageGrid(16, 16, (0.2, 0.2), (0.3, 0.3))
    views = [(View(20.0 * k, 17.0), "test-17" if k in (0, 5) else "train") for k in range(10)]
    images = np.ones((10, 16, 16), np.float32)
    dataset = dataset_of(grid, views, images, calibration="relative", looks=1.0, ground=True)
    lines = measured.shape({"T72-A64:8": dataset}, [1, 3]).splitlines()
    assert asked == [(f"T72-A64:8-shape-{seed}", 8, 9, "t72.ply", seed) for seed in (1, 3)]
    assert (tmp_path / "datasets" / "t72.ply").is_file()
    assert lines[-1] == "| T72-A64:8, against the model `t72` |" + " 2.000 ± 1.4142 |" * len(measured.SHAPE)
