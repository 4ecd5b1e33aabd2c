"""Which Gaussians lie apart from a scene, and which far structures are part of it."""

import numpy as np
import pytest

from sarsplat.data.outliers import outliers


def body(count: int, middle: tuple[float, ...] = (0, 0, 1), half: tuple[float, ...] = (3, 1, 1)) -> np.ndarray:
    return np.random.default_rng(count).uniform(-1, 1, (count, 3)) * half + middle


def found(*parts: np.ndarray, scales: np.ndarray | None = None) -> int:
    """How many strays there are, which must be the last ones."""
    means = np.concatenate(parts)
    quaternions = np.tile([1.0, 0, 0, 0], (len(means), 1))
    scales = np.full(means.shape, 0.05) if scales is None else scales
    stray = outliers(means, scales, quaternions)
    assert not stray[: len(means) - int(stray.sum())].any()
    return int(stray.sum())


VEHICLE = body(400)


APART = {
    "one": np.array([[150.0, 0, 0]]),
    "all around": np.random.default_rng(1).normal(size=(20, 3)) * 300,
    "a clump": body(5, (100, 0, 0)),
    "a clump so far away that nothing is seen": body(30, (1e5, 0, 0)),
    "above": np.array([[0.0, 0, 5000]]),
    "beyond all numbers": np.array([[1e30, 0, 0]]),
    "a fifth of all": np.random.default_rng(1).normal(size=(80, 3)) * 3000,
}
PARTS = {
    "one vehicle": [VEHICLE],
    "two vehicles": [body(400, (-30, 0, 1)), body(401, (30, 0, 1))],
    "a vehicle and one of few Gaussians": [VEHICLE, body(40, (60, 0, 1))],
    "a vehicle and one farther away": [VEHICLE, body(30, (120, 0, 1))],
    "a village and a far house": [body(3000, (0, 0, 3), (30, 30, 3)), body(25, (150, 0, 3), (5, 5, 3))],
    "a mast": [VEHICLE, np.column_stack([np.zeros(40), np.zeros(40), np.linspace(2, 40, 40)])],
    "single scatterers": [np.random.default_rng(0).uniform(-50, 50, (60, 3))],
    "a line": [np.column_stack([np.arange(30) * 10.0, np.zeros(30), np.zeros(30)])],
    "a vehicle on ground": [body(3000), np.random.default_rng(0).uniform(-50, 50, (2000, 3)) * (1, 1, 0)],
    "all at one place": [np.zeros((20, 3))],
    "two Gaussians": [np.array([[60.0, 0, 0], [0, 0, 0]])],
    "none": [np.empty((0, 3))],
}


@pytest.mark.parametrize("which", APART)
def test_what_floats_apart_is_a_stray(which):
    assert found(VEHICLE, APART[which]) == len(APART[which])


@pytest.mark.parametrize("which", PARTS)
def test_far_structure_is_part_of_the_scene(which):
    assert found(*PARTS[which]) == 0


def test_a_mast_of_a_few_long_gaussians_is_part_of_the_scene():
    mast = np.column_stack([np.zeros(8), np.zeros(8), np.linspace(2, 40, 8)])
    scales = np.full((408, 3), 0.05)
    scales[400:, 2] = 1.5
    assert found(VEHICLE, mast, scales=scales) == 0


def test_a_gaussian_far_larger_than_the_scene_is_a_stray_and_long_ones_are_not():
    scales = np.full((400, 3), 0.05)
    scales[:3, 0] = 2
    assert found(VEHICLE, scales=scales) == 0
    scales[-1] = np.exp(30)
    assert found(VEHICLE, scales=scales) == 1
    scales[-30:, 1] = 400
    assert found(VEHICLE, scales=scales) == 30
