"""Brightness of places on the ground, before anything is learned."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates

from sarsplat.data import Dataset
from sarsplat.regions.target_box import above_ground_db

_SURE_DB = 3.0
"""Level above the ground from which on a place is not speckle, dB."""


def ground_levels_db(
    train: Dataset, x: Float64[np.ndarray, "rows columns"], y: Float64[np.ndarray, "rows columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Return the median level over the images at places on the ground, dB above the usual ground; 0 if not certain.

    What stands on the ground is shown elsewhere in each image, so that half of them show a place as bright only if it
    is, or lies below something bright. Images are those of level ground.
    """
    grid, shown = train.grid, []
    for level_db, view in zip(above_ground_db(train.power, train.grid), train.views, strict=True):
        azimuth, slant_range = np.tensordot(view.look.gradients[:, :2], np.stack([x, y]), 1)
        pixel = (slant_range - grid.range_m[0]) / grid.spacing_m[1], (azimuth - grid.azimuth_m[0]) / grid.spacing_m[0]
        shown.append(map_coordinates(level_db, pixel, order=1, mode="constant", cval=np.nan).astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place that no image shows
        middle = np.nanmedian(shown, axis=0)
    return np.where(middle > _SURE_DB, middle, 0.0).astype(np.float64)
