"""How masks are compared."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from datasets import small_dataset, small_mask
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


@pytest.mark.parametrize("shift", [(2, -1), (-2, 1)])
@pytest.mark.parametrize("looks", [1.0, None])
def test_masks_lie_where_speckled_images_fit_best_and_else_where_they_are_rendered(shift, looks):
    mean = np.where(small_mask() == 1, 30.0, 1.0)
    chip = np.roll(mean, shift, (0, 1)) * np.random.default_rng(1).exponential(size=mean.shape)
    power = np.stack([chip] * 3).astype(np.float32)
    images = replace(small_dataset(), power=power, looks=looks, score_margin=1).select("test")
    run = SimpleNamespace(masks=lambda views: np.stack([small_mask()] * len(views)))
    predicted_classes = predicted_masks(run, images, np.stack([mean] * 2))
    np.testing.assert_array_equal(predicted_classes[0], np.roll(small_mask(), shift, (0, 1)) if looks else small_mask())


def test_clutter_comes_in_where_masks_are_moved_away():
    from sarsplat.evaluation.images import _displaced

    full = np.full((1, 4, 4), 2, np.uint8)
    moved = _displaced(np.repeat(full, 2, axis=0), np.array([[1, -2], [-1, 2]]))
    np.testing.assert_array_equal(moved[0], [[0, 0, 0, 0], *[[2, 2, 0, 0]] * 3])
    np.testing.assert_array_equal(moved[1], moved[0, ::-1, ::-1])
