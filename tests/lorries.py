"""A target for tests: a long box with a cabin at one end and a mast, like a lorry, of no symmetry."""

from typing import Any

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")  # by which images of it are made

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Sides, and the place of the middle, m."""

BOXES: tuple[Box, ...] = ((6, 2, 1), (0, 0, 0.5)), ((1.5, 1.8, 1.2), (2.2, 0, 1.6)), ((0.8, 0.8, 1), (-2, 0.6, 1.5))


def lorry(scale: float = 1.0) -> Any:
    """Larger or smaller."""
    parts = []
    for size, place in BOXES:
        part = trimesh.creation.box(np.multiply(size, scale))
        part.apply_translation(np.multiply(place, scale))
        parts.append(part)
    return trimesh.util.concatenate(parts)
