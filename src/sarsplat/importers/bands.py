"""What the two bands of a complex image are: real and imaginary part, or amplitude and phase."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Shaped

from sarsplat.errors import SarsplatError

Bands = Literal["real and imaginary part", "amplitude and phase in radians", "amplitude and phase in degrees"]

_HALF_TURNS: dict[Bands, float] = {"amplitude and phase in radians": math.pi, "amplitude and phase in degrees": 180.0}

_ROUNDING = 1e-5
"""Share of a half turn by which phases may exceed it."""

_SPREAD = 0.9
"""Share of a half turn that the phases of an image reach on both sides of zero."""

_BOTH_NEGATIVE = 0.75
"""Share of pixels: where the phase turns, real and imaginary part are both negative in a quarter of them."""


def meaning_of(pixels: Shaped[np.ndarray, "*shape"], name: str) -> Bands | None:
    """What two bands are, which come before or after the other dimensions; None if there are none.

    Real and imaginary parts are negative somewhere. What is not is an amplitude if the other band reaches from minus to
    plus half a turn, and anything else is refused; `name` is what to call the image.
    """
    if pixels.ndim == 2:
        return None
    first, second = _apart(pixels)
    if not np.isfinite(pixels).all() or not pixels.any() or max(first.min(), second.min()) < 0:
        measured = (first != 0) | (second != 0)
        if np.count_nonzero((first < 0) & (second < 0)) > _BOTH_NEGATIVE * np.count_nonzero(measured) > 1:
            raise SarsplatError(
                f"{name} has two bands that are both negative nearly everywhere, as decibels are and no real and "
                "imaginary part; give one of them in each file, as by gdal_translate -b 1"
            )
        return "real and imaginary part"  # what is not finite is refused by its place, and what is black by its name
    low, high = float(second.min()), float(second.max())
    for bands, half_turn in _HALF_TURNS.items():
        spread = min(-low, high) >= _SPREAD * half_turn and max(-low, high) <= (1 + _ROUNDING) * half_turn
        if first.min() >= 0 and spread:
            return bands
    which = "neither is ever" if low >= 0 <= first.min() else "one is never"
    raise SarsplatError(
        f"{name} has two bands, of which {which} negative: no real and imaginary part, and no amplitude with a phase "
        "from −π to π after it; give one band of power or amplitude, or complex numbers"
    )


def joined(pixels: Shaped[np.ndarray, "*shape"], name: str) -> Shaped[np.ndarray, "rows columns"]:
    """Complex numbers, if need be of two bands."""
    bands = meaning_of(pixels, name)
    if bands is None:
        return pixels
    first, second = _apart(pixels)
    if bands == "real and imaginary part":
        return first + np.complex64(1j) * second
    turned: Shaped[np.ndarray, "rows columns"] = first * np.exp(1j * math.pi / _HALF_TURNS[bands] * second)
    return turned


def _apart(pixels: Shaped[np.ndarray, "*shape"]) -> tuple[np.ndarray, np.ndarray]:
    first, second = pixels if pixels.shape[0] == 2 else np.moveaxis(pixels, -1, 0)
    return first, second
