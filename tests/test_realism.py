"""Statistics of generated chips: they see what they are meant to see."""

from dataclasses import replace

import numpy as np
import pytest

from sarsplat.geometry.responses import TAYLOR
from sarsplat.scenes import mstar_grid
from sarsplat.scenes.scattering import ResponseSpeckle

CLUTTER = np.zeros((40, 128, 128), np.uint8)


def clutter(seed: int) -> np.ndarray:
    speckle, rng = ResponseSpeckle(replace(mstar_grid(), response=TAYLOR)), np.random.default_rng(seed)
    return np.stack([np.rint(40 * np.abs(speckle.draw(rng))) for _ in CLUTTER]).astype(np.uint8)


def test_neighbours_are_alike_in_speckle_and_not_in_noise(module) -> None:
    alike = module("experiments/chip_statistics").alike
    assert alike(clutter(0), CLUTTER, 1) == pytest.approx(0.48, abs=0.03)
    assert alike(clutter(0), CLUTTER, 2) == pytest.approx(0.52, abs=0.03)
    white = np.random.default_rng(0).integers(0, 255, CLUTTER.shape).astype(np.uint8)
    assert abs(alike(white, CLUTTER, 1)) < 0.02


def test_clutter_is_apart_from_targets(module) -> None:
    statistics = module("experiments/chip_statistics")
    masks = CLUTTER[:1].copy()
    masks[0, 60, 60] = statistics.TARGET
    found = statistics.apart(masks)[0]
    assert (found[60, 60], found[60, 68], found[60, 69]) == (1, 3, 0)


def test_histograms_are_as_far_apart_as_their_levels(module) -> None:
    statistics = module("experiments/chip_statistics")
    levels = [np.full_like(CLUTTER[:2], level) for level in (20, 40)]
    distance = statistics.histogram_distance_db(levels[0], CLUTTER[:2], levels[1], CLUTTER[:2], 0)
    assert distance == pytest.approx(6.02, abs=0.01)
    assert statistics.darkness(levels[0] // 10) == 1
    assert statistics.bright_pixels(np.where(CLUTTER[:2] == 0, 128, 0)) == 128 * 128


def test_alike_sets_are_not_told_apart_and_others_are(module, monkeypatch) -> None:
    program = module("experiments/tell_apart")
    for name, value in (("_STEPS", 12), ("_BATCH", 8)):
        monkeypatch.setattr(program, name, value)
    one = clutter(1)[:16]
    assert program.area_under_curve(one, one) == 0.5
    assert program.area_under_curve(one, one // 3) > 0.95
