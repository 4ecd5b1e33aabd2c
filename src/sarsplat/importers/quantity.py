"""Conversion of pixel values to power or complex amplitude: amplitude, power, decibels, complex."""

from __future__ import annotations

from typing import get_args

import numpy as np
from jaxtyping import Shaped

from sarsplat.errors import SarsplatError, shown
from sarsplat.names import Quantity
from sarsplat.radiometry import from_db

QUANTITIES: tuple[str, ...] = get_args(Quantity)


def likely_quantity(pixels: Shaped[np.ndarray, "*shape"], name: str) -> Quantity:
    """What pixels of this type usually are: complex numbers themselves, and whole numbers scaled amplitudes.

    Of real numbers nothing is usual, so they are refused.
    """
    if pixels.dtype.kind == "c" or pixels.ndim == 3:
        return "complex"
    if pixels.dtype.kind in "iu":
        return "amplitude"
    raise SarsplatError(
        f"{name} holds {pixels.dtype} numbers, which may be anything; say with --quantity whether they are "
        "amplitude, power or db"
    )


def power_or_signal(
    pixels: Shaped[np.ndarray, "*shape"], quantity: Quantity, name: str, scale: float = 1.0, offset: float = 0.0
) -> Shaped[np.ndarray, "rows columns"]:
    """Linear power (float32), or complex amplitude (complex64) where the phase is available.

    Parameters
    ----------
    pixels : numpy.ndarray
        [rows, columns], or two bands: the real and the imaginary part, before or after the other dimensions.
    quantity : {"amplitude", "power", "db", "complex"}
        What `scale`·pixels + `offset` is.
    name : str
        What to call the image.
    scale, offset : float
        For decibels in 8 bits, for example, 60/255 and −60.

    Raises
    ------
    SarsplatError
        If the pixels are of another kind than the quantity, or one is not finite, too large, or negative.
    """
    kind = "complex" if pixels.dtype.kind == "c" or pixels.ndim == 3 else "real"
    if (kind == "complex") != (quantity == "complex"):
        raise SarsplatError(
            f"{name} holds {kind} numbers, but the quantity is {quantity!r}; give "
            + ("'complex'" if kind == "complex" else "amplitude, power or db")
        )
    value: Shaped[np.ndarray, "rows columns"]
    with np.errstate(over="ignore", invalid="ignore"):
        if quantity == "complex":
            value = _joined(pixels).astype(np.complex64) * np.float32(scale)
        else:
            value = pixels.astype(np.float32) * np.float32(scale) + np.float32(offset)
        if quantity == "db":
            value = from_db(value)
        fits = np.isfinite(value) if quantity == "complex" else np.isfinite(value) & (value >= 0)
        value = value**2 if quantity == "amplitude" else value
    if not fits.all():
        place = tuple(int(index) for index in np.argwhere(~fits)[0])
        scaled = "" if (scale, offset) == (1, 0) else f", times {scale:g} plus {offset:g},"
        negative = quantity in ("amplitude", "power") and np.isfinite(value[place])
        too_large = quantity == "db" and np.isfinite(pixels[place])
        remedy = (
            "if the numbers are decibels, give --quantity db; if not, cut the image"
            if negative
            else "no decibels are that large; give --quantity amplitude or power"
            if too_large
            else "if that is what the numbers are, cut the image or fill the gap"
        )
        raise SarsplatError(f"{name} holds {shown(pixels[place].tolist())} at {place}{scaled} as {quantity}; {remedy}")
    return value


def _joined(pixels: Shaped[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "rows columns"]:
    """Complex numbers, if need be of two bands."""
    if pixels.ndim == 2:
        return pixels
    real, imaginary = pixels if pixels.shape[0] == 2 else np.moveaxis(pixels, -1, 0)
    return real + np.complex64(1j) * imaginary
