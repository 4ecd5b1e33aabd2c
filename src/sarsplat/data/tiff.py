"""One image as a TIFF: power as float32, complex amplitudes as complex64."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Complex64, Float32, Real, Shaped

from sarsplat.data.files import open_file, write_bytes
from sarsplat.data.image import check_power, power_of
from sarsplat.errors import SarsplatError, shown

_LONGEST_HEADER = 1 << 20  # bytes of a TIFF that are not pixels: tags, descriptions

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


def write_power_tiff(path: Path, power: Real[np.ndarray, "rows columns"], description: str) -> None:
    """Write an image as an uncompressed single-page float32 TIFF, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    power : numpy.ndarray, float32 [rows, columns]
        Linear power, row 0 near range.
    description : str
        What it shows, for whoever opens the file elsewhere (ASCII; the ImageDescription tag).
    """
    _write(path, np.asarray(power, dtype=np.float32), description)


def write_signal_tiff(path: Path, signal: Complex64[np.ndarray, "rows columns"], description: str) -> None:
    """Write complex amplitudes as an uncompressed single-page complex64 TIFF, whole or not at all.

    Parameters
    ----------
    path, description
        See `write_power_tiff`.
    signal : numpy.ndarray, complex64 [rows, columns]
        Complex amplitudes, row 0 near range.
    """
    _write(path, signal, description)


def _write(path: Path, image: Shaped[np.ndarray, "rows columns"], description: str) -> None:
    buffer = io.BytesIO()
    image = np.ascontiguousarray(image)
    tifffile.imwrite(
        buffer, image, photometric="minisblack", metadata=None, description=description, software="sarsplat"
    )
    write_bytes(path, buffer.getvalue())


def read_power_tiff(path: Path, shape: tuple[int, int]) -> Float32[np.ndarray, "{shape[0]} {shape[1]}"]:
    """Read an image of power that must have the given shape.

    Parameters
    ----------
    path : Path
        An uncompressed float32 TIFF; its header is trusted only where it fits `shape` and the size of the file.
    shape : (int, int)
        Rows and columns to expect.

    Returns
    -------
    numpy.ndarray, float32 [rows, columns]
        Linear power.

    Raises
    ------
    SarsplatError
        If the file is missing, damaged, truncated, compressed, of another shape or type, or holds NaN, an infinity or
        negative power.
    """
    power = _read(Path(path), shape, np.dtype(np.float32))
    check_power(power, str(path))
    return power


def read_signal_tiff(path: Path, shape: tuple[int, int]) -> Complex64[np.ndarray, "{shape[0]} {shape[1]}"]:
    """Read complex amplitudes that must have the given shape.

    Parameters
    ----------
    path : Path
        An uncompressed complex64 TIFF, trusted as little as `read_power_tiff` does.
    shape : (int, int)
        Rows and columns to expect.

    Returns
    -------
    numpy.ndarray, complex64 [rows, columns]
        Complex amplitudes.

    Raises
    ------
    SarsplatError
        As `read_power_tiff`.
    """
    signal = _read(Path(path), shape, np.dtype(np.complex64))
    check_power(power_of(signal), str(path))
    return signal


def _read(path: Path, shape: tuple[int, int], dtype: np.dtype[Any]) -> Shaped[np.ndarray, "{shape[0]} {shape[1]}"]:
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
    return np.asarray(image, dtype=dtype)
