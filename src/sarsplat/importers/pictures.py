"""Pixels of PNG, JPEG, NPY, MATLAB and raster files, as linear power or complex amplitude.

Files are untrusted: a header is believed only if it fits the file.
"""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Shaped

from sarsplat.data.files import open_file, plain_os_errors
from sarsplat.data.geotiff import refuse_turned
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import needed
from sarsplat.importers.columns import FACTORS, told_of_factor
from sarsplat.importers.files import complex_of
from sarsplat.importers.mat import read_mat
from sarsplat.importers.rasters import OTHERS, TIFF, Tags, read_raster, refuse_bomb, sidecar_scaling
from sarsplat.names import Quantity
from sarsplat.radiometry import from_db

PICTURE_ENDINGS = (*OTHERS, *TIFF)
"""Usual endings of pictures; others are read by GDAL."""

Bands = Literal["real and imaginary part", "amplitude and phase in radians", "amplitude and phase in degrees"]
_HALF_TURNS: dict[Bands, float] = {"amplitude and phase in radians": math.pi, "amplitude and phase in degrees": 180.0}
_ROUNDING = 1e-5  # share of a half turn by which phases may exceed it
_SPREAD = 0.9  # share of a half turn that the phases of an image reach on both sides of zero
_BOTH_NEGATIVE = 0.75
"""Maximum share of pixels with negative real and imaginary part; a turning phase has both in a quarter of them."""

_MANY_WRONG = (OSError, SyntaxError, ValueError, ZeroDivisionError, OverflowError, EOFError, TypeError, struct.error)


def read_pixels(path: Path) -> Shaped[np.ndarray, "*shape"]:
    """Read the pixels of an image (see `read_picture`); raise if a mask leaves some out."""
    pixels, tags = read_picture(path)
    if tags.absent is not None:
        _refuse_masked(path, tags.absent)
    return pixels


def _refuse_masked(path: Path, absent: Bool[np.ndarray, "rows columns"]) -> None:
    if absent.any():
        raise SarsplatError(
            f"{path} masks {absent.sum()} of its {absent.size} pixels, whose values mean nothing; cut the image, or "
            "save it without its mask or transparency if they were measured"
        )


def read_picture(path: Path) -> tuple[Shaped[np.ndarray, "*shape"], Tags]:
    """Read the pixels of one image, [rows, columns] or two bands before or after these, and its tags.

    Grey pictures stored in colour become grey. Files other than PNG, JPEG, NPY and MATLAB are read by GDAL, which reads
    tags. Raises if the file is damaged, of another format, in colour, of several pages or matrices, holds Python
    objects, or unpacks to far more than its size.
    """
    ending, tags = path.suffix.lower(), Tags()
    if ending in OTHERS:
        pixels = complex_of({".npy": _npy, ".mat": _mat}.get(ending, _picture)(path))
        tags = sidecar_scaling(path)
    else:
        pixels, tags = read_raster(path)
    if pixels.ndim == 3 and 1 in pixels.shape[::2]:
        pixels = pixels[0] if pixels.shape[0] == 1 else pixels[..., 0]
    bands = pixels.ndim == 3 and 2 in pixels.shape[::2]
    if pixels.dtype.kind not in "iufc" or not (pixels.ndim == 2 or bands) or pixels.size == 0:
        raise SarsplatError(
            f"{path} holds {pixels.dtype} of shape {shown(pixels.shape)}; give numbers in rows and columns (or two "
            "bands of them, the real and the imaginary part)"
        )
    return pixels, tags


def _npy(path: Path) -> Shaped[np.ndarray, "*shape"]:
    with open_file(path):  # a regular file that can be read
        pass
    try:
        # mapped: an array that is larger than the file is refused before there is memory for it
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except MemoryError:
        raise
    except Exception as error:  # a garbled header can fail anywhere inside the parser, with any exception
        raise SarsplatError(
            f"{path} is not a readable array of numbers ({shown(str(error))}); write it again with numpy.save"
        ) from error


def _mat(path: Path) -> Shaped[np.ndarray, "*shape"]:
    """Read the only matrix of a file; other variables may be numbers and rows of numbers."""
    variables = read_mat(path)
    matrices = [name for name, value in variables.items() if isinstance(value, np.ndarray) and min(value.shape) > 1]
    if len(matrices) != 1:
        names = f"{len(matrices)} matrices ({', '.join(matrices[:5])})" if matrices else "no matrix of numbers"
        raise SarsplatError(f"{path} has {names}; give one image for each file")
    return np.asarray(variables[matrices[0]])


def _picture(path: Path) -> Shaped[np.ndarray, "*shape"]:
    with needed("mstar", "a PNG or JPEG"):
        from PIL import ExifTags, Image, UnidentifiedImageError

    with plain_os_errors("read", path), open_file(path) as file:
        data = file.read()
    try:
        image = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
        refuse_bomb(path, math.prod(image.size) * len(image.getbands()))
        refuse_turned(path, image.getexif().get(ExifTags.Base.Orientation, 1))
        if (image.mode == "L" and "transparency" not in image.info) or image.mode[0] in "IF":
            return np.asarray(image)
        coloured = np.asarray(image.convert("RGBA"))
    except (*_MANY_WRONG, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:  # what Pillow says
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({shown(str(error))})"
        raise SarsplatError(f"{path} is not a PNG or JPEG, or is damaged{why}; save it again") from error
    colours = coloured[..., :3]
    if (colours != colours[..., :1]).any():
        raise SarsplatError(f"{path} is a picture in colour; give the measured values, in grey")
    _refuse_masked(path, coloured[..., 3] < 255)
    return colours[..., 0]


def likely_quantity(pixels: Shaped[np.ndarray, "*shape"], name: str, real: Quantity | None = None) -> Quantity:
    """Return the quantity of pixels by their type: complex numbers are complex, whole numbers amplitude, others `real`.

    Raises for other numbers if `real` is None.
    """
    if pixels.dtype.kind == "c" or pixels.ndim == 3:
        return "complex"
    if real is not None:
        return real
    if pixels.dtype.kind in "iu":
        return "amplitude"
    raise SarsplatError(
        f"{name} holds {pixels.dtype} numbers of unknown meaning; say by `quantity` whether they are amplitude, power "
        "or db"
    )


def power_or_signal(
    pixels: Shaped[np.ndarray, "*shape"], quantity: Quantity, name: str, scale: float = 1.0, offset: float = 0.0
) -> Shaped[np.ndarray, "rows columns"]:
    """Return linear power (float32), or complex amplitude (complex64) where the phase is available.

    Pixels are [rows, columns], or two bands before or after these; `quantity` is that of `scale`·pixels + `offset`, for
    decibels in 8 bits, for example, 60/255 and −60. Raises, naming the image `name`, if they are not of the quantity's
    kind, or one is not finite, too large, or negative.
    """
    kind = "complex" if pixels.dtype.kind == "c" or pixels.ndim == 3 else "real"
    if (kind == "complex") != (quantity == "complex"):
        right = "`quantity='complex'`" if kind == "complex" else "amplitude, power or db as `quantity`"
        raise SarsplatError(f"{name} holds {kind} numbers, but the quantity is {quantity!r}; give {right}")
    value: Shaped[np.ndarray, "rows columns"]
    with np.errstate(over="ignore", invalid="ignore"):
        if quantity == "complex":
            value = _joined(pixels, name).astype(np.complex64) * np.float32(scale)
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
            "if the numbers are decibels, give `quantity='db'`; if not, cut the image"
            if negative
            else "no decibels are that large; give another `quantity`, such as amplitude or power"
            if too_large
            else "if that is what the numbers are, cut the image or fill the gap"
        )
        raise SarsplatError(f"{name} holds {shown(pixels[place].tolist())} at {place}{scaled} as {quantity}; {remedy}")
    return value


def meaning_of(pixels: Shaped[np.ndarray, "*shape"], name: str) -> Bands | None:
    """Return the meaning of two bands, first or last dimension; None for a single band.

    Real and imaginary parts are negative somewhere; amplitudes are not, and their phases spread from minus to plus half
    a turn. Raises otherwise, naming the image `name`.
    """
    if pixels.ndim == 2:
        return None
    first, second = _two_bands(pixels)
    if not np.isfinite(pixels).all() or not pixels.any() or max(first.min(), second.min()) < 0:
        measured = (first != 0) | (second != 0)
        if np.count_nonzero((first < 0) & (second < 0)) > _BOTH_NEGATIVE * np.count_nonzero(measured) > 1:
            raise SarsplatError(
                f"{name} has two bands that are both negative nearly everywhere, as decibels are and no real and "
                "imaginary part; give one of them in each file, as by gdal_translate -b 1"
            )
        return "real and imaginary part"  # infinite and black pixels are rejected elsewhere
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


def _joined(pixels: Shaped[np.ndarray, "*shape"], name: str) -> Shaped[np.ndarray, "rows columns"]:
    """Join two bands, if there are two, to complex numbers."""
    bands = meaning_of(pixels, name)
    if bands is None:
        return pixels
    first, second = _two_bands(pixels)
    if bands == "real and imaginary part":
        return first + np.complex64(1j) * second
    signal: Shaped[np.ndarray, "rows columns"] = first * np.exp(1j * math.pi / _HALF_TURNS[bands] * second)
    return signal


def _two_bands(pixels: Shaped[np.ndarray, "*shape"]) -> tuple[np.ndarray, np.ndarray]:
    first, second = pixels if pixels.shape[0] == 2 else np.moveaxis(pixels, -1, 0)
    return first, second


@dataclass(frozen=True)
class Values:
    """Values of one picture, the tags of its file, and the quantity of its numbers."""

    image: Shaped[np.ndarray, "rows columns"]
    """Linear power (float32), or complex amplitude (complex64); 0 where it is not known."""
    unknown: Bool[np.ndarray, "rows columns"]
    """Pixels without data."""
    tags: Tags
    quantity: Quantity
    power_factor: float
    """Factor on the power that the file states, and that is not yet in it; 1 where the user states another."""
    assumptions: tuple[str, ...]
    """Assumptions about tags and bands."""


def read_values(
    path: Path, quantity: Quantity | None, scale: float, offset: float, real: Quantity | None = None, own: bool = True
) -> Values:
    """Read a picture; `quantity` is that of scale · pixel + offset, None to infer it from the type of the numbers.

    `real` is the quantity of real numbers, if known. Scale, offset and factor of the file count if `own`. Raises as
    `read_picture` and `power_or_signal` do, if no pixel has data, or if these contradict each other or the quantity.
    """
    pixels, tags = read_picture(path)
    name, told = str(path), []
    found = quantity or likely_quantity(pixels, name, real)
    if (absent := tags.absent) is not None:  # values there are replaced by one that is always valid
        if absent.all():
            raise SarsplatError(f"{name} holds nothing but pixels without data; leave out its row")
        pixels = np.where(absent, pixels[~absent][0] if pixels.ndim == 2 else pixels.dtype.type(0), pixels)
    if found == "complex" and (bands := meaning_of(pixels, name)):
        told.append(f"the two bands of complex pictures are {bands}")
    factor, scaled = 1.0, (tags.scale, tags.offset) != (1.0, 0.0)
    if not own and (tags.factors or scaled):
        told.append("the files state scales or factors, which are not used, for others are given")
    elif tags.factors:
        (meaning, number), *others = tags.factors
        exponent, quantities = FACTORS[meaning]
        factor = number**exponent
        told.append(told_of_factor(meaning, f"each file's {meaning}"))
        if others or scaled or found not in quantities:
            stated = ", ".join(f"{meaning} {number:g}" for meaning, number in tags.factors)
            beside = f", scale {tags.scale:g} and offset {tags.offset:g}" if scaled else ""
            raise SarsplatError(
                f"{name} states {stated}{beside}, which do not belong together for numbers that are {found}; import "
                "them with the right ones as `scale` (1 leaves out those of the files), or in a column of the table"
            )
    elif scaled:
        scale, offset = tags.scale, tags.offset
        told.append("pixels are multiplied by the files' scales, and their offsets added")
    image = power_or_signal(pixels, found, name, scale, offset)
    absent = np.zeros(image.shape, bool) if absent is None else absent
    if tags.backscatter:
        told.append(f"power is {tags.backscatter}, as the files say")
    return Values(np.where(absent, image.dtype.type(0), image), absent, tags, found, factor, tuple(told))
