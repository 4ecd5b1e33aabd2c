"""Crop of an image around the target."""

from __future__ import annotations

import numpy as np
from jaxtyping import Real

from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter

_MARGIN = 5  # pixels around the target


def target_window(images: Real[np.ndarray, "v rows columns"], peak: float, margin: int = 0) -> tuple[slice, slice]:
    """The rows and columns worth showing: the target with a margin if all around is dark, else what is scored.

    What is `DYNAMIC_RANGE_DB` below `peak` is dark; `margin` is how many pixels on each side are not scored.
    """
    size = images.shape[1:]
    bright = brighter(images.max(axis=0), -DYNAMIC_RANGE_DB, peak)
    if not bright.any() or bright.mean() > 0.5:
        return slice(margin, size[0] - margin), slice(margin, size[1] - margin)
    spans = [np.flatnonzero(bright.any(axis=1 - axis))[[0, -1]] for axis in (0, 1)]
    side = max(int(span[1] - span[0]) for span in spans) + 1 + 2 * _MARGIN
    first = [(int(span.sum()) + 1 - side) // 2 for span in spans]
    rows, columns = (slice(max(start, 0), start + side) for start in first)  # cut where it leaves the image
    return rows, columns
