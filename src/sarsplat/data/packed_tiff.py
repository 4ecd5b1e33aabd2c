"""Pixels of a TIFF that someone else wrote, also packed: tifffile unpacks them, and asks imagecodecs for most of that.

What is known to come out as other numbers than libtiff's is refused, and so is what may unpack to more than its file
says: imagecodecs makes room for what JPEG and LERC themselves say.
"""

from __future__ import annotations

import itertools
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from tifffile import COMPRESSION, TiffFile

from sarsplat.data.foreign_tiff import opened_tiff
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import install_command

_READ = {
    COMPRESSION.NONE,
    COMPRESSION.LZW,
    COMPRESSION.ADOBE_DEFLATE,
    COMPRESSION.DEFLATE,
    COMPRESSION.ZSTD,
    COMPRESSION.LZMA,
    COMPRESSION.PACKBITS,
}
"""Of these no more is unpacked than the file says."""
_DIFFERENCES = 2
"""A predictor."""
_OTHER_ORDER = 24
"""Bits of whole numbers that libtiff writes in the order of the file, and tifffile reads highest first."""
_MOST_PAGES = 16
_LARGEST_TILE = 1 << 24

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


def pixels_of(page: Any, data: bytes, name: str) -> Shaped[np.ndarray, "*shape"]:
    """The pixels of tifffile's `page` in the file of these bytes, as they are stored; `name` is what to call it.

    Raises whatever tifffile or imagecodecs raise about damaged files, and `SarsplatError` for what is not read, or not
    without imagecodecs. How much they unpack to is for the caller to check before.
    """
    try:
        if page.compression == COMPRESSION.JPEG and page.bitspersample == 8 and page.samplesperpixel == 1:
            return _of_jpegs(page, data)
        _refuse_others(page, name)
        return np.asarray(page.asarray(maxworkers=1))
    except Exception as error:  # of several types, as long as imagecodecs is missing
        if "imagecodecs" not in str(error):
            raise
        raise SarsplatError(
            f"{name} is packed ({_packing(page)}), which needs imagecodecs; {install_command('tiff')}"
        ) from error


def _packing(page: Any) -> str:
    how = page.compression
    words = [how.name if isinstance(how, COMPRESSION) else f"compression {shown(how)}"]
    if page.predictor != 1:
        words.append(f"PREDICTOR={int(page.predictor)}")
    if page.bitspersample not in (8, 16, 32, 64, 128):
        words.append(f"NBITS={page.bitspersample}")
    return " ".join(words)


def _refuse_others(page: Any, name: str) -> None:
    kind = np.dtype(page.dtype).kind
    other_sums = page.predictor == _DIFFERENCES and kind == "c"  # of the numbers, where libtiff adds up their bits
    if page.compression not in _READ or other_sums:
        remedy = "COMPRESS=DEFLATE -co PREDICTOR=1"
    elif page.bitspersample == _OTHER_ORDER and kind == "u":
        remedy = "NBITS=32"
    else:
        return
    raise SarsplatError(
        f"{name} holds {page.dtype} numbers as {_packing(page)}, which is not read; write it again, as by "
        f"gdal_translate -co {remedy}"
    )


def _of_jpegs(page: Any, data: bytes) -> UInt8[np.ndarray, "rows columns"]:
    """Of grey ones. Each is unpacked into its place, so that none can be larger."""
    import imagecodecs

    (rows, columns), across = page.chunks, page.chunked[-1]
    pixels = np.full((page.chunked[0] * rows, across * columns), page.nodata, np.uint8)
    for k, (place, length) in enumerate(zip(page.dataoffsets, page.databytecounts)):
        top, left = k // across * rows, k % across * columns
        high = rows if page.is_tiled else min(rows, page.imagelength - top)
        if length:
            part = np.empty((high, columns), np.uint8)
            imagecodecs.jpeg_decode(data[place : place + length], tables=page.jpegtables, out=part)
            pixels[top : top + high, left : left + columns] = part
    return pixels[: page.imagelength, : page.imagewidth]


def masked_out(tiff: TiffFile, page: Any, data: bytes, path: Path) -> Bool[np.ndarray, "rows columns"] | None:
    """Where a mask leaves pixels of `page` out; None without one.

    GDAL keeps it in a page of its own, or in a file beside, PATH.msk.
    """
    beside = path.with_name(f"{path.name}.msk")
    pages = [other.aspage() for other in itertools.islice(tiff.pages, _MOST_PAGES)]
    masks = [other for other in pages if other.is_mask and not other.is_reduced]
    if masks:
        return _absent(masks[0], data, page.shape[:2], f"the mask of {path}", alone=len(masks) == 1)
    if not beside.is_file():
        return None
    with opened_tiff(beside, "") as (other, data):
        return _absent(other.pages.first, data, page.shape[:2], str(beside), alone=True)


def _absent(
    mask: Any, data: bytes, shape: tuple[int, ...], name: str, *, alone: bool
) -> Bool[np.ndarray, "rows columns"]:
    if not alone or mask.shape != shape or math.prod(mask.chunks) > max(mask.size, _LARGEST_TILE):
        raise SarsplatError(f"{name} is not one of the pixels of the image; write that again, without it")
    absent: Bool[np.ndarray, "rows columns"] = pixels_of(mask, data, name) == 0
    return absent
