"""A box on the ground, seen from twelve sides, with masks."""

from __future__ import annotations

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat import Dataset, ImageGrid, ScatteringLaw, View, simulate_raycast
from sarsplat.data import write_dataset

GRID = ImageGrid(28, 24, (0.3, 0.35), (0.3, 0.35))
BOX = (3.0, 2.0, 1.2)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    from sarsplat.scenes.raycast_masks import raycast_masks

    mesh = trimesh.creation.box(BOX)
    mesh.apply_translation([0, 0, BOX[2] / 2])
    views = [(View(azimuth, grazing), "train") for azimuth in range(0, 360, 60) for grazing in (20.0, 50.0)]
    views += [(View(azimuth, 35.0), "test") for azimuth in (30, 200)]
    images = np.stack([simulate_raycast(mesh, view, GRID, ScatteringLaw()) for view, _ in views])
    made = dataset_of(GRID, views, images, source={"kind": "raycast"})
    masks = raycast_masks(mesh, [view for view, _ in views], GRID)
    path = tmp_path_factory.mktemp("box") / "dataset"
    return write_dataset(path, made, truth_mesh=mesh, masks=masks)
