"""How samples are weighted across band and aperture: narrow response, or low side lobes."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.optimize import brentq
from scipy.signal.windows import taylor

Weighting = Literal["uniform", "taylor"]

TAYLOR_DB = 35.0
TAYLOR_NBAR = 4
"""Side lobes of the weighting `taylor`, dB below the peak, and how many of them are as high."""

_POINTS = 2001


def weights(weighting: Weighting, places: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Weights at places from −½ to ½ of the band or aperture."""
    if weighting == "uniform":
        return np.ones_like(places)
    curve = taylor(_POINTS, nbar=TAYLOR_NBAR, sll=TAYLOR_DB)
    return np.interp(places, np.linspace(-0.5, 0.5, _POINTS), curve)


def width(weighting: Weighting) -> float:
    """3 dB width of the power response, in units of 1/extent: of a band B it is `width`·c/2B."""
    return 2 * brentq(lambda t: float(_transform(weighting, np.array([t]))[0]) - math.sqrt(0.5), 0, 1)


def response(weighting: Weighting, places: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Amplitude of a point in the image, 1 at its place; `places` in units of the 3 dB width."""
    return _transform(weighting, places * width(weighting))


def _transform(weighting: Weighting, places: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    samples = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    shares = weights(weighting, samples)
    return np.cos(2 * np.pi * places[:, None] * samples) @ shares / shares.sum()
