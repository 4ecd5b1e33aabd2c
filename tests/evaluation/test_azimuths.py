"""Azimuths of test images by predictions from all around: errors, and scores of them."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from made import dataset_of
from sarsplat import Dataset, ImageGrid, View
from sarsplat.evaluation import AZIMUTH_METRICS, UndefinedScore, azimuths
from sarsplat.evaluation.metrics import compute_all

GRID = ImageGrid(48, 48, (0.3, 0.3), (0.3, 0.3))
TRUE_DEG = np.arange(4.0, 360.0, 44.0)


def predicted(turned_deg: float) -> Callable[[Sequence[View]], np.ndarray]:
    """Predictions that are turned: an arm that sweeps around a spot."""
    away, across = np.meshgrid(GRID.range_m, GRID.azimuth_m, indexing="ij")

    def power(view: View) -> np.ndarray:
        angle = np.radians(view.azimuth_deg + turned_deg)
        arm = [np.exp(-((across - r * np.cos(angle)) ** 2 + (away - r * np.sin(angle)) ** 2)) for r in range(4)]
        return 0.1 + 5 * np.maximum.reduce(arm)

    return lambda views: np.stack([power(view) for view in views]).astype(np.float32)


RUN = SimpleNamespace(grid=GRID, masks=lambda views: np.ones((len(views), 48, 48), np.uint8))


@pytest.fixture
def tested(monkeypatch) -> Dataset:
    monkeypatch.setattr(azimuths, "FEWEST", 4)
    views = [View(azimuth, grazing) for azimuth in TRUE_DEG for grazing in (15.2, 29.8)]
    images = predicted(0.0)(views) * np.random.default_rng(0).exponential(size=(len(views), 48, 48))
    return dataset_of(GRID, [(view, "test") for view in views], images.astype(np.float32), looks=1.0, ground=True)


def test_errors_are_those_of_the_predictions(tested: Dataset) -> None:
    right, turned, reversed_ = azimuths.azimuth_errors(RUN, tested, [predicted(turn) for turn in (0.0, 20.0, 180.0)])
    assert np.abs(right).max() < 4
    np.testing.assert_allclose(turned, -20, atol=4)
    assert np.abs(reversed_).min() > 176
    scores = compute_all(AZIMUTH_METRICS, tested, np.concatenate([right, turned, reversed_]), "", {})
    assert scores["azimuth_within@5"] == scores["azimuth_reversed"] == pytest.approx(1 / 3)
    assert scores["azimuth_error_deg"] == pytest.approx(20, abs=2)


def test_a_glint_that_no_prediction_has_hardly_turns_images(tested: Dataset) -> None:
    tested.power[:, 24, 36] = 300
    assert np.median(np.abs(azimuths.azimuth_errors(RUN, tested, [predicted(0.0)]))) < 1.6  # exponential: 2.5


def test_where_none_can_be_found(tested: Dataset) -> None:
    with pytest.raises(UndefinedScore, match="at least 4 images; these are 3"):
        azimuths.azimuth_errors(RUN, tested.take([0, 1, 2]), [predicted(0.0)])
    with pytest.raises(UndefinedScore, match="the prediction is black around the origin"):
        azimuths.azimuth_errors(RUN, tested, [lambda views: np.zeros((len(views), 48, 48), np.float32)])
    tested.power[0] = 0
    with pytest.raises(UndefinedScore, match="an image is black around the origin"):
        azimuths.azimuth_errors(RUN, tested, [predicted(0.0)])
