"""One image as a TIFF: power as float32, complex amplitudes as complex64."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import numpy as np
import tifffile
from jaxtyping import Shaped
from numpy.typing import DTypeLike

from sarsplat.data.files import open_file, write_bytes
from sarsplat.data.image import check_power, power_of
from sarsplat.errors import SarsplatError, shown

_LONGEST_HEADER = 1 << 20  # bytes of a TIFF that are not pixels: tags, descriptions

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


def write_tiff(path: Path, image: Shaped[np.ndarray, "rows columns"], description: str) -> None:
    """Write an image as an uncompressed TIFF of one page, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    image : numpy.ndarray [rows, columns]
        Linear power, stored as float32, or complex amplitudes, stored as complex64; row 0 near range.
    description : str
        What it shows, for other programs (ASCII; the ImageDescription tag).
    """
    buffer = io.BytesIO()
    pixels = np.ascontiguousarray(image, dtype=np.complex64 if np.iscomplexobj(image) else np.float32)
    tifffile.imwrite(
        buffer, pixels, photometric="minisblack", metadata=None, description=description, software="sarsplat"
    )
    write_bytes(path, buffer.getbuffer())


def read_tiff(
    path: Path, shape: tuple[int, int], pixel: DTypeLike = np.float32
) -> Shaped[np.ndarray, "{shape[0]} {shape[1]}"]:
    """Read an image that must have the given shape and pixels.

    Parameters
    ----------
    path : Path
        An uncompressed TIFF; its header is trusted only where it fits `shape` and the size of the file.
    shape : (int, int)
        Rows and columns to expect.
    pixel : numpy dtype
        float32 for linear power, complex64 for complex amplitudes.

    Raises
    ------
    SarsplatError
        If the file is missing, damaged, truncated, compressed, of another shape or type, or its power is negative,
        absurdly large or not finite.
    """
    path, dtype = Path(path), np.dtype(pixel)
    pixel_bytes = dtype.itemsize * shape[0] * shape[1]
    with open_file(path) as file:
        size = file.seek(0, 2)
        if not pixel_bytes <= size <= pixel_bytes + _LONGEST_HEADER:
            raise SarsplatError(
                f"{path} has {size} bytes, too {'few' if size < pixel_bytes else 'many'} for {shape[0]} × {shape[1]} "
                f"{dtype} pixels; it is truncated, compressed or of another size: create the dataset again"
            )
        file.seek(0)
        data = file.read()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            page = tiff.pages.first
            layout = (page.shape, page.dtype, page.compression, tiff.pages.is_multipage)
            image = page.asarray() if layout == (shape, dtype, tifffile.COMPRESSION.NONE, False) else None
    except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        raise SarsplatError(f"{path} is not a readable TIFF ({shown(str(error))}); create the dataset again") from error
    if image is None:
        raise SarsplatError(
            f"{path} holds {layout[1]} pixels of shape {shown(layout[0])}, compression {layout[2]!r:.30}, on "
            f"{'several pages' if layout[3] else 'one page'}; give one page of uncompressed {dtype} of shape {shape}"
        )
    image = np.asarray(image, dtype=dtype)
    check_power(power_of(image) if np.iscomplexobj(image) else image, str(path))
    return image
