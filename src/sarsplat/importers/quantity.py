"""What the numbers of an image stand for: amplitude, power, decibels, or complex amplitudes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import get_args

import numpy as np
from jaxtyping import Float64, Num, Shaped
from scipy.ndimage import uniform_filter

from sarsplat.errors import SarsplatError, shown
from sarsplat.names import Quantity
from sarsplat.radiometry import from_db, to_db

QUANTITIES: tuple[str, ...] = get_args(Quantity)

_EIGHT_BITS = "--scale and --offset, such as --scale 0.2353 --offset -60 for −60 to 0 dB in 8 bits"
_WIDEST_DB = 100.0
"""From the darkest percent of an image to the brightest thousandth: speckle goes 20 dB down, targets 50 dB up."""
_SKEWED, _UNCERTAIN = 0.05, 6.0
"""Skewness that decides, and by how much more it must be, divided by the root of the number of pixels."""
_MOST_IMAGES, _LARGEST_PART, _NEIGHBOURHOOD = 40, 256, 5
"""How many images are looked at, how many pixels of a side, and the pixels around one that its surroundings are."""


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
        remedy = (
            "if the numbers are decibels, give --quantity db; if not, cut the image"
            if negative
            else "if that is what the numbers are, cut the image or fill the gap"
        )
        raise SarsplatError(f"{name} holds {shown(pixels[place].tolist())} at {place}{scaled} as {quantity}; {remedy}")
    return value


def doubts(images: Sequence[Num[np.ndarray, "rows columns"]], quantity: Quantity) -> str | None:
    """A sentence if linear power, calculated from numbers of this quantity, can hardly be that; otherwise None.

    Parameters
    ----------
    images : sequence of numpy.ndarray
        Linear power with speckle; of each of some of them the middle is looked at.
    quantity : {"amplitude", "power", "db", "complex"}
        What they were calculated from.

    Notes
    -----
    Speckle tells: about the local mean, amplitudes and powers have their long tail on the bright side, whatever the
    number of looks, and decibels on the dark side. Bowley's coefficient of skewness is 0.15, 0.47 and −0.22 for one
    look, and neither a factor nor an offset changes it.
    """
    if quantity == "complex":
        return None
    middles = [_middle(image) for image in images[:: math.ceil(len(images) / _MOST_IMAGES)]]
    if quantity == "db":
        decibels = to_db(np.concatenate([part.ravel() for part in middles]))
        low, high = np.percentile(decibels, (1, 99.9))
        if decibels.min() >= 0 and high - low > _WIDEST_DB:  # below zero go floors of simulated images
            return (
                f"as decibels, the numbers span {high - low:.0f} dB, and those of radar images hardly {_WIDEST_DB:g}; "
                f"if they are those of a picture, give {_EIGHT_BITS}; if they are amplitude, give --quantity amplitude"
            )
    numbers = [part.astype(np.float64) for part in middles]
    if quantity != "power":
        numbers = [to_db(part) if quantity == "db" else np.sqrt(part) for part in numbers]
    deviations = np.concatenate([_from_local_mean(part) for part in numbers])
    if len(deviations) == 0:
        return None
    dark, middle, bright = np.quantile(deviations, (0.1, 0.5, 0.9))
    skewness = (bright + dark - 2 * middle) / max(bright - dark, np.finfo(np.float64).tiny)
    sure = _SKEWED + _UNCERTAIN / math.sqrt(len(deviations))
    if quantity == "db" and skewness > sure:
        return (
            "the speckle has its long tail on the bright side, as that of amplitude and power has, but the numbers are "
            "read as decibels; if they are amplitude, give --quantity amplitude"
        )
    if quantity != "db" and skewness < -sure:
        return (
            f"the speckle has its long tail on the dark side, as that of decibels has, but the numbers are read as "
            f"{quantity}; if they are decibels, give --quantity db, and if they are those of a picture also "
            f"{_EIGHT_BITS}"
        )
    return None


def _middle(image: Num[np.ndarray, "rows columns"]) -> Num[np.ndarray, "m n"]:
    top, left = (max(0, (side - _LARGEST_PART) // 2) for side in image.shape)
    return image[top : top + _LARGEST_PART, left : left + _LARGEST_PART]


def _from_local_mean(numbers: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " n"]:
    """Deviations from the mean of the neighbourhood, in its standard deviations; where all is the same, none."""
    mean = uniform_filter(numbers, _NEIGHBOURHOOD)
    variance = uniform_filter(numbers**2, _NEIGHBOURHOOD) - mean**2
    varied = variance > 1e-9 * np.max(numbers**2)
    return (numbers - mean)[varied] / np.sqrt(variance[varied])


def _joined(pixels: Shaped[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "rows columns"]:
    """Complex numbers, if need be of two bands."""
    if pixels.ndim == 2:
        return pixels
    real, imaginary = pixels if pixels.shape[0] == 2 else np.moveaxis(pixels, -1, 0)
    return real + np.complex64(1j) * imaginary
