"""Pixels of a TIFF that someone else wrote, also in compressions for which tifffile would need another package.

OpenCV writes LZW unless it is told otherwise, and so does GDAL in cloud-optimised files; predictors for floating-point
numbers are usual in heights. Pillow brings a libtiff that knows these.
"""

from __future__ import annotations

import io
import itertools
import logging
import math
import warnings
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped
from tifffile import COMPRESSION, PHOTOMETRIC, TiffFile

from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command

_KNOWN = {COMPRESSION.LZW, COMPRESSION.ADOBE_DEFLATE, COMPRESSION.DEFLATE, COMPRESSION.ZSTD, COMPRESSION.JPEG}
"""What Pillow's libtiff is asked for."""
_BITS = {8, 12, 16, 32}
_ORIENTATION = 274
_MOST_PAGES = 16
_LARGEST_TILE = 1 << 24

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


def pixels_of(page: Any, data: bytes, name: str) -> Shaped[np.ndarray, "*shape"]:
    """The pixels of tifffile's `page` in the file of these bytes, as they are stored; `name` is what to call it.

    Raises whatever tifffile or Pillow raise about damaged files, and `SarsplatError` for a compression that neither
    knows. How much they unpack to is for the caller to check before.
    """
    try:
        return np.asarray(page.asarray(maxworkers=1))
    except Exception as error:
        if not isinstance(error, ImportError) and "imagecodecs" not in str(error):
            raise
        if _for_pillow(page):
            return _by_pillow(page, data, name)
        bits = int(page.bitspersample)
        how, remedy = page.compression.name, "COMPRESS=DEFLATE -co PREDICTOR=1"
        if page.predictor > 1:
            how += f" with predictor {int(page.predictor)}"
        if bits % 8:
            how, remedy = f"{bits} bits each", f"NBITS={bits + -bits % 8}"
        bands = "" if page.samplesperpixel == 1 else f" in {page.samplesperpixel} bands"
        raise SarsplatError(
            f"{name} holds {page.dtype} numbers{bands} as {how}, which is not read; write it again, as by "
            f"gdal_translate -co {remedy}"
        ) from error


def _for_pillow(page: Any) -> bool:
    """Whether Pillow hands out what is stored: it turns pictures as their tags say, swaps bytes of big-endian numbers
    that were packed once too often, and knows one real band.
    """
    tags = {tag.code: tag.value for tag in page.tags.values()}
    return (
        page.compression in _KNOWN | {COMPRESSION.NONE}
        and page.samplesperpixel == 1
        and page.photometric == PHOTOMETRIC.MINISBLACK
        and page.bitspersample in _BITS
        and (page.bitspersample == 8 or page.parent.byteorder == "<")
        and (page.dtype.kind in "iu" or page.dtype == np.float32)
        and tags.get(_ORIENTATION, 1) == 1
    )


def _by_pillow(page: Any, data: bytes, name: str) -> Shaped[np.ndarray, "rows columns"]:
    try:
        from PIL import Image
    except ImportError as error:
        raise SarsplatError(
            f"reading {page.compression.name} in {name} needs Pillow; {install_command('mstar')}"
        ) from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures
        image = Image.open(io.BytesIO(data), formats=("TIFF",))
        image.seek(page.index)
        pixels = np.asarray(image)
    if pixels.shape != page.shape:
        raise ValueError(f"its pixels have the shape {pixels.shape}, not {page.shape}")
    return pixels.astype(page.dtype)  # whole numbers may come in wider ones, or with another sign


def masked_out(tiff: TiffFile, page: Any, data: bytes, name: str) -> Bool[np.ndarray, "rows columns"] | None:
    """Where a mask beside `page` leaves its pixels out, as GDAL keeps one in a page of its own; None without one."""
    pages = [other.aspage() for other in itertools.islice(tiff.pages, _MOST_PAGES)]
    masks = [other for other in pages if other.is_mask and not other.is_reduced]
    if not masks:
        return None
    mask = masks[0]
    if len(masks) > 1 or mask.shape != page.shape[:2] or math.prod(mask.chunks) > max(mask.size, _LARGEST_TILE):
        raise SarsplatError(f"{name} has masks that are not one of its pixels; write it again, without them")
    absent: Bool[np.ndarray, "rows columns"] = pixels_of(mask, data, f"the mask of {name}") == 0
    return absent
