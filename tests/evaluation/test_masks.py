"""How masks are compared."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from datasets import small_dataset, small_mask
from sarsplat.data import Dataset
from sarsplat.evaluation import MaskPair, UndefinedScore, predicted_masks


def test_iou_is_averaged_over_images():
    truth = np.stack([small_mask(), small_mask(), np.zeros_like(small_mask())])
    half = small_mask()
    half[5:8, 4:6] = 0
    pair = MaskPair(truth, np.stack([half, small_mask(), np.zeros_like(small_mask())]))
    assert pair.iou(1) == pytest.approx((0.5 + 1) / 2)  # the empty image does not count
    assert pair.iou(2) == 1
    with pytest.raises(UndefinedScore, match="neither"):
        MaskPair(truth[2:], truth[2:]).iou(1)


def moving(looks: float | None) -> tuple[Dataset, np.ndarray]:
    """A speckled chip whose target lies two rows farther and a column to the left of where it is rendered."""
    mean = np.where(small_mask() == 1, 30.0, 1.0)
    chip = np.roll(mean, (2, -1), (0, 1)) * np.random.default_rng(1).exponential(size=mean.shape)
    power = np.stack([chip] * 3).astype(np.float32)
    return replace(small_dataset(), power=power, looks=looks, score_margin=1).select("test"), np.stack([mean] * 2)


def test_masks_lie_where_the_images_fit_best():
    images, rendered = moving(1.0)
    run = SimpleNamespace(masks=lambda views: np.stack([small_mask()] * len(views)))
    found = predicted_masks(run, images, rendered)
    np.testing.assert_array_equal(found[0], np.roll(small_mask(), (2, -1), (0, 1)))


def test_masks_are_not_moved_where_there_is_no_speckle():
    images, rendered = moving(None)
    run = SimpleNamespace(masks=lambda views: np.stack([small_mask()] * len(views)))
    np.testing.assert_array_equal(predicted_masks(run, images, rendered)[0], small_mask())


def test_clutter_comes_in_where_masks_are_moved_away():
    from sarsplat.evaluation.masks import _displaced

    full = np.full((1, 4, 4), 2, np.uint8)
    moved = _displaced(full, np.array([[1, -2]]))
    np.testing.assert_array_equal(moved[0], [[0, 0, 0, 0], *[[2, 2, 0, 0]] * 3])
