"""One image as a TIFF: power as float32, complex amplitudes as complex64; of a stack, a page for each pass."""

from __future__ import annotations

import io
import itertools
import logging
import math
from pathlib import Path

import numpy as np
import tifffile
from jaxtyping import Shaped
from numpy.typing import DTypeLike

from sarsplat.data.files import open_file, write_bytes
from sarsplat.data.image import check_power, power_of
from sarsplat.errors import SarsplatError, counted, shown

_LONGEST_HEADER = 1 << 20  # maximum size of tags and descriptions of a TIFF, bytes

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # sarsplat's errors describe damaged files


def write_tiff(path: Path, image: Shaped[np.ndarray, "*passes rows columns"], description: str) -> None:
    """Write an image [rows, columns], or a stack [P, rows, columns] of a page each, as an uncompressed TIFF.

    Linear power is stored as float32, complex amplitudes as complex64; row 0 near range. `description` is the text of
    the ImageDescription tag, ASCII.
    """
    buffer = io.BytesIO()
    pixels = np.ascontiguousarray(image, dtype=np.complex64 if np.iscomplexobj(image) else np.float32)
    tifffile.imwrite(
        buffer, pixels, photometric="minisblack", metadata=None, description=description, software="sarsplat"
    )
    write_bytes(path, buffer.getbuffer())


def read_tiff(path: Path, shape: tuple[int, ...], pixel: DTypeLike = np.float32) -> Shaped[np.ndarray, "*shape"]:
    """Read an image that must have this shape, [rows, columns] or [P, rows, columns], and pixels.

    These are float32 for linear power, complex64 for complex amplitudes. The header of the file is trusted only where
    it fits the shape and the size of the file. Raise SarsplatError if the file is missing, damaged, truncated,
    compressed, of another shape or type, or its power is negative, absurdly large or not finite.
    """
    path, dtype = Path(path), np.dtype(pixel)
    pixel_bytes, pages = dtype.itemsize * math.prod(shape), shape[0] if len(shape) == 3 else 1
    with open_file(path) as file:
        size = file.seek(0, 2)
        if not pixel_bytes <= size <= pixel_bytes + _LONGEST_HEADER:
            raise SarsplatError(
                f"{path} has {size} bytes, too {'few' if size < pixel_bytes else 'many'} for "
                f"{' × '.join(map(str, shape))} {dtype} pixels; it is truncated, compressed or of another size: create "
                "the dataset again"
            )
        file.seek(0)
        data = file.read()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            checked = itertools.islice(tiff.pages, pages + 1)  # a hostile file may list millions
            layouts = [(page.shape, page.dtype, page.compression) for page in checked]
            fits = layouts == [(shape[-2:], dtype, tifffile.COMPRESSION.NONE)] * pages
            image = tiff.asarray(key=slice(None)).reshape(shape) if fits else None
    except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        raise SarsplatError(f"{path} is not a readable TIFF ({shown(str(error))}); create the dataset again") from error
    if image is None:
        held = [f"{kind} pixels of shape {shown(size)}, compression {packed!r:.30}" for size, kind, packed in layouts]
        raise SarsplatError(
            f"{path} holds {'no page' if not held else held[0]}{' and more pages' if len(held) > 1 else ''}; give "
            f"{counted(pages, 'page')} of uncompressed {dtype} of shape {shape[-2:]}"
        )
    image = np.asarray(image, dtype=dtype)
    check_power(power_of(image), str(path))
    return image
