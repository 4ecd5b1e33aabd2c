"""Speckle: the random power of a distributed target in a coherent image."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Real

from sarsplat.errors import SarsplatError


def add_speckle(
    power: Real[np.ndarray, "*shape"], looks: float, rng: np.random.Generator
) -> Float[np.ndarray, "*shape"]:
    """Fully developed, spatially white speckle on an intensity image.

    Parameters
    ----------
    power : numpy.ndarray
        β⁰ or any linear power, ≥ 0, any shape.
    looks : float
        Number of looks L > 0: every pixel is multiplied by a gamma variate of mean 1 and variance 1/L
        (L = 1: exponential, single look).
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    numpy.ndarray
        Speckled power, shape and dtype of `power`.

    Raises
    ------
    SarsplatError
        If `looks` is not positive and finite.
    """
    if not (math.isfinite(looks) and looks > 0):
        raise SarsplatError(f"looks {looks} must be positive and finite; leave it out for a clean image")
    return (power * rng.gamma(looks, 1 / looks, size=power.shape)).astype(power.dtype)
