"""One picture under two directions, not pixel by pixel: turned, mirrored, scaled or compressed again.

Speckle of two directions is independent, or nearly so if they lie within one aperture; that of a picture that was
copied is the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Shaped
from scipy.ndimage import uniform_filter

from sarsplat.data import Dataset
from sarsplat.examination.repeated import apart_deg, said_of_pairs
from sarsplat.radiometry import LEAST_POWER, to_db

_SIDE = 96
"""Pixels along a side of what is compared, from the middle: far more than tell speckle from other speckle."""

_LOCAL = 5
"""Side of the mean that is taken out, in pixels: what is left is speckle, not the target."""

_SAME_SPECKLE = 0.7
"""Correlation of logarithms: measured chips have up to 0.24, and apertures that share three quarters of their pulses
0.56."""

_UNLIKE = 0.3
"""Median over all pairs of images that have speckle."""

_APART_DEG = 2.0
"""Directions farther apart do not share an aperture."""

_MOST_LOOKS = 32.0
"""Of speckle that can be told from other speckle."""

_TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda image: image,
    ", turned by a half": lambda image: image[..., ::-1, ::-1],
    ", mirrored": lambda image: image[..., ::-1],
    ", upside down": lambda image: image[..., ::-1, :],
    ", turned by a quarter": lambda image: np.rot90(image, 1, axes=(-2, -1)),
    ", turned by a quarter ": lambda image: np.rot90(image, 3, axes=(-2, -1)),
    ", turned and mirrored": lambda image: np.rot90(image, 1, axes=(-2, -1))[..., ::-1],
    ", turned and mirrored ": lambda image: np.rot90(image, 3, axes=(-2, -1))[..., ::-1],
}
"""What is done to a copy, to augment a set."""

_AROUND_DB = 15.0
"""Of the ground: what is darker or brighter is shadow or target, which may be symmetric."""

_FEWEST_PIXELS = 64
"""Of less, speckle may be alike by chance."""


def copied_images(dataset: Dataset) -> list[str]:
    """Whether images of different directions have the same speckle; a list of one sentence, or empty.

    Asked of images with ground and speckle: of others there is as much to see of a target's symmetry.
    """
    if dataset.looks is None or dataset.looks > _MOST_LOOKS:
        return []
    if dataset.clean_tests:
        dataset = dataset.select("train")
    if len(dataset) < 2:
        return []
    speckle = _speckle(dataset.power)
    if speckle[0].size < _FEWEST_PIXELS:
        return []
    flat = speckle.reshape(len(speckle), -1)
    for what, turn in _TURNS.items():
        turned = turn(speckle)
        if turned.shape != speckle.shape:
            continue
        alike = flat @ turned.reshape(len(turned), -1).T
        if not what and np.median(alike[np.triu_indices(len(alike), 1)]) > _UNLIKE:
            return []  # no speckle that tells images apart
        pairs = map(tuple, np.argwhere(np.triu(alike > _SAME_SPECKLE, 1)).tolist())
        found = [(i, j) for i, j in pairs if apart_deg(dataset.views[i], dataset.views[j]) > _APART_DEG]
        if found:
            return said_of_pairs(dataset, found, what.rstrip() or ", perhaps scaled or compressed again")
    return []


def _speckle(power: Shaped[np.ndarray, "v rows columns"]) -> Float32[np.ndarray, "v along across"]:
    """Logarithms of the middle of each image less their local mean, with norm 1."""
    rows, columns = (slice((size - min(size, _SIDE)) // 2, (size + min(size, _SIDE)) // 2) for size in power.shape[1:])
    middle = to_db(power[:, rows, columns], LEAST_POWER).astype(np.float32)
    ground = np.median(middle, axis=(1, 2), keepdims=True)
    middle = np.clip(middle, ground - _AROUND_DB, ground + _AROUND_DB)
    rest = middle - uniform_filter(middle, (0, _LOCAL, _LOCAL), mode="nearest")
    rest -= rest.mean(axis=(1, 2), keepdims=True)
    norm = np.sqrt(np.square(rest).sum(axis=(1, 2), keepdims=True))
    return rest / np.maximum(norm, np.finfo(np.float32).tiny)
