"""Pixels of PNG, JPEG, NPY, MATLAB and raster files, and what they stand for: amplitude, power, decibels, complex.

Pixels are those that are stored; a header is believed only if it fits.
"""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from sarsplat.data.files import open_file, plain_os_errors
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import install_command
from sarsplat.importers.bands import joined
from sarsplat.importers.mat import read_mat
from sarsplat.importers.rasters import OTHERS, TIFF, Tags, read_raster
from sarsplat.names import Quantity
from sarsplat.radiometry import from_db

PICTURE_ENDINGS = (*OTHERS, *TIFF)
"""Usual endings of pictures; others are read by GDAL."""
_FREE_BYTES, _BYTES_PER_BYTE = 4 << 20, 64
"""Measured images do not compress much: what unpacks to more than this, and so many times its size, is a bomb."""

_MANY_WRONG = (OSError, SyntaxError, ValueError, ZeroDivisionError, OverflowError, EOFError)


def read_pixels(path: Path) -> Shaped[np.ndarray, "*shape"]:
    """The pixels alone of `read_picture`; refused if some are left out by a mask."""
    pixels, tags = read_picture(path)
    if tags.absent is not None:
        raise SarsplatError(
            f"{path} masks {tags.absent.sum()} of its {tags.absent.size} pixels, whose values mean nothing; cut the "
            "image, or save it without its mask or transparency"
        )
    return pixels


def read_picture(path: Path) -> tuple[Shaped[np.ndarray, "*shape"], Tags]:
    """The pixels of one image: [rows, columns], or with a third dimension of 2 on either side of these: two bands.

    Grey pictures that are stored in colour are grey here. What is neither PNG, JPEG, NPY nor MATLAB is read by GDAL,
    and what it says of its pixels is handed back. Refused if it cannot be read, is damaged or of another format, in
    colour, of several pages or matrices, holds Python objects, or unpacks to far more than its size.
    """
    ending, tags = path.suffix.lower(), Tags()
    if ending in OTHERS:
        pixels = {".npy": _npy, ".mat": _mat}.get(ending, _picture)(path)
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
    with open_file(path) as file:
        if file.read(6) != b"\x93NUMPY":
            raise SarsplatError(f"{path} is not a NumPy file; write it with numpy.save")
    try:
        # mapped: an array that is larger than the file is refused before there is memory for it
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except MemoryError as error:
        raise SarsplatError(f"{path} does not fit into memory; cut the image") from error
    except Exception as error:  # a garbled header can fail anywhere inside the parser, with any exception
        raise SarsplatError(
            f"{path} is not a readable array of numbers ({shown(str(error))}); write it again with numpy.save"
        ) from error


def _mat(path: Path) -> Shaped[np.ndarray, "*shape"]:
    """The one matrix among a file's variables; numbers and lines of numbers may lie beside it."""
    variables = read_mat(path)
    matrices = [name for name, value in variables.items() if isinstance(value, np.ndarray) and min(value.shape) > 1]
    if len(matrices) != 1:
        names = f"{len(matrices)} matrices ({', '.join(matrices[:5])})" if matrices else "no matrix of numbers"
        raise SarsplatError(f"{path} has {names}; give one image for each file")
    return np.asarray(variables[matrices[0]])


def _picture(path: Path) -> Shaped[np.ndarray, "*shape"]:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise SarsplatError(f"reading PNG and JPEG needs Pillow; {install_command('mstar')}") from error
    with plain_os_errors("read", path), open_file(path) as file:
        data = file.read()
    try:
        image = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
        if (unpacked := math.prod(image.size) * len(image.getbands()) * 2) > max(
            _FREE_BYTES, _BYTES_PER_BYTE * len(data)
        ):
            raise SarsplatError(f"{path} has {len(data)} bytes but claims to hold {unpacked}; save it again")
        if (image.mode == "L" and "transparency" not in image.info) or image.mode[0] in "IF":
            return np.asarray(image)
        coloured = np.asarray(image.convert("RGBA"))
    except (*_MANY_WRONG, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:  # what Pillow says
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({shown(str(error))})"
        raise SarsplatError(f"{path} is not a PNG or JPEG, or is damaged{why}; save it again") from error
    colours, opaque = coloured[..., :3], coloured[..., 3] == 255
    if (colours != colours[..., :1]).any():
        raise SarsplatError(f"{path} is a picture in colour; give the measured values, in grey")
    if not opaque.all():
        raise SarsplatError(
            f"{path} has transparent pixels, {(~opaque).sum()} of {opaque.size}, whose values mean nothing; cut the "
            "image, or save it without transparency if they hold measured values too"
        )
    return colours[..., 0]


def likely_quantity(pixels: Shaped[np.ndarray, "*shape"], name: str, real: Quantity | None = None) -> Quantity:
    """What pixels of this type usually are: complex numbers themselves, and whole numbers scaled amplitudes.

    Of real numbers nothing is usual, so they are refused, unless it is known what they are (`real`).
    """
    if pixels.dtype.kind == "c" or pixels.ndim == 3:
        return "complex"
    if real is not None:
        return real
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

    Pixels are [rows, columns], or two bands (`bands.joined`), before or after the other dimensions;
    `quantity` is what `scale`·pixels + `offset` is, for decibels in 8 bits, for example, 60/255 and −60. Refused if
    they are of another kind than the quantity, or one is not finite, too large, or negative; `name` is what to call the
    image.
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
            value = joined(pixels, name).astype(np.complex64) * np.float32(scale)
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
