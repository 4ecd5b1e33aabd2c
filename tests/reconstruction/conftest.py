"""A small box, seen from twelve sides, and a short training on it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from datasets import FEW_POINTS, box_dataset
from sarsplat import Dataset, ImageGrid, Run, preset, reconstruct
from sarsplat.reconstruction import Config

GRID = ImageGrid(32, 32, (0.3, 0.3), (0.45, 0.45))


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return box_dataset(tmp_path_factory.mktemp("box"), GRID)


@pytest.fixture(scope="session")
def config() -> Config:
    short = {"iterations": 60, "gaussians": 600, "harmonics_every": 20, "checkpoint_every": 20}
    return replace(preset("default"), **short, points=FEW_POINTS)


@pytest.fixture(scope="session")
def finished(dataset: Dataset, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return reconstruct(dataset, config, tmp_path_factory.mktemp("run") / "run")
