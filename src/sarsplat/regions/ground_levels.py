"""Brightness of places on the ground, before anything is learned."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float64

from sarsplat.data import Dataset
from sarsplat.regions.image_levels import above_ground_db, values_at

_SURE_DB = 3.0
"""Minimum level of bright ground, dB above the usual ground; less is speckle."""


def ground_levels_db(
    train: Dataset, x: Float64[np.ndarray, "ny nx"], y: Float64[np.ndarray, "ny nx"]
) -> Float64[np.ndarray, "ny nx"]:
    """Return the median level over the images at places on level ground (m), dB above the usual ground; 0 if speckle.

    Objects are displaced differently in each image, so the median is high only where the ground is bright or under a
    bright object.
    """
    places = np.stack([x, y, np.zeros_like(x)], axis=-1)
    levels_db = above_ground_db(train.power, train.grid)
    shown = [values_at(image, view, train.grid, places) for image, view in zip(levels_db, train.views, strict=True)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place that no image shows
        middle = np.nanmedian(shown, axis=0)
    return np.where(middle > _SURE_DB, middle, 0.0).astype(np.float64)
