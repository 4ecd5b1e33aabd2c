"""Datasets for tests, made of an array of images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sarsplat import ScatteringLaw, preset, simulate_raycast
from sarsplat.data import Dataset, DatasetEntry, write_dataset
from sarsplat.geometry import ImageGrid, Stack, View

FEW_POINTS = replace(preset("default").points, voxel=0.3, rays_per_pixel=2.0)
"""Of small targets: points and their normals would otherwise take ten times as long as a short training."""

SMALL = ImageGrid(16, 12, (0.3, 0.3), (0.4, 0.4))
TINY = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35), (1.0, -2.0))
VIEWS = [
    (View(0.1, 15.0), "train"),
    (View(-45.0, 30.0), "test-17"),
    (View(400.0, 75.0), "train"),
    (View(90.0, 17.09375), "test"),
]
NOISE = np.random.default_rng(1).gamma(1.0, size=(4, 6, 5)).astype(np.float32)
SIGNALS = (np.random.default_rng(2).normal(size=(4, 6, 5, 2)) @ [1, 1j]).astype(np.complex64)


def box_dataset(folder: Path, grid: ImageGrid, *, masks: bool = False) -> Dataset:
    """A box on the ground, seen from twelve sides and two others, by ray casting."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    from sarsplat.scenes.raycast import raycast_masks

    sides = (3.0, 2.0, 1.2)
    mesh = trimesh.creation.box(sides)
    mesh.apply_translation([0, 0, sides[2] / 2])
    views = [(View(azimuth, grazing), "train") for azimuth in range(0, 360, 60) for grazing in (20.0, 50.0)]
    views += [(View(azimuth, 35.0), "test") for azimuth in (30, 200)]
    images = np.stack([simulate_raycast(mesh, view, grid, ScatteringLaw()) for view, _ in views])
    made = dataset_of(grid, views, images, source={"kind": "raycast"})
    true = raycast_masks(mesh, [view for view, _ in views], grid) if masks else None
    return write_dataset(folder / "dataset", made, truth_mesh=mesh, masks=true)


def small_dataset(**fields: Any) -> Dataset:
    """Three images of 16 × 12 pixels of 0.3 m, one to train on."""
    views = [(View(0, 30), "train"), (View(90, 30), "test"), (View(180, 30), "test")]
    return dataset_of(SMALL, views, np.ones((3, 16, 12), np.float32), ground=True, **fields)


def tiny_dataset(
    images: np.ndarray = NOISE, *, grid: ImageGrid = TINY, views: Sequence[tuple[View, str]] = VIEWS, **fields: Any
) -> Dataset:
    """Four images of 6 × 5 uneven pixels, of three sets."""
    return dataset_of(grid, views, images, **{"source": {"kind": "made up"}, **fields})


def small_mask() -> np.ndarray:
    """For such an image: a target above its shadow, left of the middle."""
    found = np.zeros((16, 12), np.uint8)
    found[5:8, 2:6], found[8:12, 2:6] = 1, 2
    return found


def dataset_of(
    grid: ImageGrid, views: Sequence[tuple[View, str]], images: np.ndarray, *, stack: Stack | None = None, **fields: Any
) -> Dataset:
    """A dataset in memory, with phases if images have them or are stacks; views are (view, split), and images are named
    by their numbers: 000, 001 …
    """
    entries = tuple(DatasetEntry(view, split, f"{index:03d}", stack=stack) for index, (view, split) in enumerate(views))
    return (Dataset.of_complex if np.iscomplexobj(images) else Dataset)(grid, entries, images, **fields)
