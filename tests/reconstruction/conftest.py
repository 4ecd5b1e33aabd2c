"""A small box, seen from twelve sides, and a short training on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat import Dataset, ImageGrid, Run, ScatteringLaw, View, preset, reconstruct, simulate_raycast
from sarsplat.data import write_dataset
from sarsplat.reconstruction import Config

GRID = ImageGrid(32, 32, (0.3, 0.3), (0.45, 0.45))
BOX = (3.0, 2.0, 1.2)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    mesh = trimesh.creation.box(BOX)
    mesh.apply_translation([0, 0, BOX[2] / 2])
    views = [(View(azimuth, grazing), "train") for azimuth in range(0, 360, 60) for grazing in (20.0, 50.0)]
    views += [(View(azimuth, 35.0), "test") for azimuth in (30, 200)]
    images = np.stack([simulate_raycast(mesh, view, GRID, ScatteringLaw()) for view, _ in views])
    path = tmp_path_factory.mktemp("box") / "dataset"
    return write_dataset(path, dataset_of(GRID, views, images, source={"kind": "raycast"}), truth_mesh=mesh)


@pytest.fixture(scope="session")
def config() -> Config:
    return replace(preset("default"), iterations=60, gaussians=600, harmonics_every=20, checkpoint_every=20)


@pytest.fixture(scope="session")
def finished(dataset: Dataset, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return reconstruct(dataset, config, tmp_path_factory.mktemp("run") / "run")
