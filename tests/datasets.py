"""Datasets for tests, made of an array of images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.geometry import ImageGrid, View


def dataset_of(grid: ImageGrid, views: Sequence[tuple[View, str]], images: np.ndarray, **fields: Any) -> Dataset:
    """A dataset in memory; views are (view, split), and images are named by their numbers: 000, 001 …"""
    entries = tuple(DatasetEntry(view, split, f"{index:03d}") for index, (view, split) in enumerate(views))
    return Dataset(grid, entries, images, **fields)
