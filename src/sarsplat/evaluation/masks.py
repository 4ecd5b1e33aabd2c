"""How well predicted masks of target and shadow agree with true ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from scipy.ndimage import shift

from sarsplat.data import Dataset, Masks
from sarsplat.evaluation.images import Stack, UndefinedScore, register
from sarsplat.runs import Run


@dataclass(frozen=True)
class MaskPair:
    """Masks of some images of one test set."""

    truth: Masks
    predicted: Masks
    """0 clutter, 1 target, 2 shadow; those predicted are shifted to where their images fit best."""

    def iou(self, kind: int) -> float:
        """Intersection over union of one kind of pixels, averaged over the images where truth or prediction has any.

        Undefined (`UndefinedScore`) if there are none.
        """
        truth, predicted = self.truth == kind, self.predicted == kind
        both, either = ((one.sum(axis=(1, 2))) for one in (truth & predicted, truth | predicted))
        if not either.any():
            raise UndefinedScore("neither the true nor the predicted masks have such pixels")
        return float(np.mean(both[either > 0] / either[either > 0]))


def predicted_masks(run: Run, images: Dataset, rendered: Stack) -> Masks:
    """Masks of a run for the images of one set, moved as `register` moves the rendered images if they are speckled.

    The position of a chip in its frame is thus estimated from its likelihood, never from true masks.

    Raises
    ------
    UndefinedScore
        As in `register`.
    """
    masks = run.masks(images.views)
    if images.looks is None:
        return masks
    return _displaced(masks, register(images.power, rendered, images.score_margin).shift)


def _displaced(masks: Masks, shifts: Int64[np.ndarray, "v 2"]) -> Masks:
    """Shift each mask by whole pixels (range, azimuth), with clutter at the edges."""
    return np.stack([shift(mask, moved, order=0) for mask, moved in zip(masks, shifts, strict=True)])
