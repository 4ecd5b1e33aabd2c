"""Pixels of a TIFF that someone else wrote, also in compressions for which tifffile would need another package.

OpenCV writes LZW unless it is told otherwise, and so does GDAL in cloud-optimised files; predictors for floating-point
numbers are usual in heights. Pillow brings a libtiff that unpacks these. It is only asked for bytes, by a directory in
which a pixel is as wide as it has bytes: of pixels it knows few kinds, and swaps the bytes of some.
"""

from __future__ import annotations

import io
import itertools
import logging
import math
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from tifffile import COMPRESSION, PLANARCONFIG, SAMPLEFORMAT, TiffFile

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import install_command

_KNOWN = {COMPRESSION.LZW, COMPRESSION.ADOBE_DEFLATE, COMPRESSION.DEFLATE, COMPRESSION.ZSTD, COMPRESSION.JPEG}
"""What Pillow's libtiff is asked for."""
_BITS = (8, 16, 32, 64, 128)
_DIFFERENCES, _FLOATING_POINT = 2, 3
"""Predictors."""
_JPEG_TABLES = 347
_MOST_PAGES = 16
_LARGEST_TILE = 1 << 24
_BYTES_AT_ONCE = 1 << 26
"""Pillow takes what is more than twice as large for a bomb; how much a file may unpack to is decided before."""
_HEADER = 8

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


def pixels_of(page: Any, data: bytes, name: str) -> Shaped[np.ndarray, "*shape"]:
    """The pixels of tifffile's `page` in the file of these bytes, as they are stored; `name` is what to call it.

    Raises whatever tifffile or Pillow raise about damaged files, and `SarsplatError` for a compression that neither
    knows. How much they unpack to is for the caller to check before.
    """
    if page.predictor == _DIFFERENCES and np.dtype(page.dtype).kind == "c" and _can_be_unpacked(page):
        return _unpacked(page, data, name)  # of these tifffile adds up the numbers, where libtiff does their bits
    try:
        return np.asarray(page.asarray(maxworkers=1))
    except Exception as error:
        if not isinstance(error, ImportError) and "imagecodecs" not in str(error):
            raise
        if _can_be_unpacked(page):
            return _unpacked(page, data, name)
        bits = int(page.bitspersample)
        how, remedy = page.compression.name, "COMPRESS=DEFLATE -co PREDICTOR=1"
        if bits not in _BITS:
            how, remedy = f"{bits} bits each", f"NBITS={next(more for more in _BITS if more >= min(bits, _BITS[-1]))}"
        raise SarsplatError(
            f"{name} holds {page.dtype} numbers as {how}, which is not read; write it again, as by "
            f"gdal_translate -co {remedy}"
        ) from error


def _can_be_unpacked(page: Any) -> bool:
    jpeg = page.compression == COMPRESSION.JPEG
    return (
        page.compression in _KNOWN
        and page.bitspersample in ((8,) if jpeg else _BITS)
        and not (jpeg and page.samplesperpixel > 1)
        and page.fillorder == 1
        and page.imagedepth == 1
    )


def _unpacked(page: Any, data: bytes, name: str) -> Shaped[np.ndarray, "*shape"]:
    """The pixels by way of their bytes; of tiles and strips, some rows at a time. Those left out hold no data."""
    together = page.planarconfig != PLANARCONFIG.SEPARATE
    samples = page.samplesperpixel if together else 1
    wide, high = (page.tilewidth, page.tilelength) if page.is_tiled else (page.imagewidth, page.rowsperstrip)
    high = high if page.is_tiled else min(high, page.imagelength)
    across, down = math.ceil(page.imagewidth / wide), math.ceil(page.imagelength / high)
    width = wide * page.bitspersample // 8 * samples
    at_once = max(1, _BYTES_AT_ONCE // (width * across * high))
    planes = []
    for plane in range(1 if together else page.samplesperpixel):
        parts = []
        for first in range(0, down, at_once):
            rows = min(at_once, down - first)
            begin = (plane * down + first) * across
            stored = [k for k in range(begin, begin + rows * across) if page.databytecounts[k]]
            numbers = np.full((rows * across, high, wide, samples), page.nodata, page.dtype)
            if stored:
                cut = 0 if page.is_tiled or stored[-1] + 1 < (plane + 1) * down else high * down - page.imagelength
                file = _of_bytes(page, data, stored, (width, high), (width, high * len(stored) - cut))
                pieces = np.pad(_read_by_pillow(page, file, name), ((0, cut), (0, 0)))
                numbers[np.array(stored) - begin] = _numbers(page, pieces, samples).reshape(-1, *numbers.shape[1:])
            numbers = numbers.reshape(rows, across, high, wide, samples).swapaxes(1, 2)
            parts.append(numbers.reshape(rows * high, across * wide, samples))
        planes.append(np.concatenate(parts)[: page.imagelength, : page.imagewidth])
    return (planes[0] if together else np.stack(planes)).reshape(page.shape)


def _read_by_pillow(page: Any, file: bytes, name: str) -> UInt8[np.ndarray, "rows bytes"]:
    try:
        from PIL import Image
    except ImportError as error:
        raise SarsplatError(
            f"reading {page.compression.name} in {name} needs Pillow; {install_command('mstar')}"
        ) from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures
        return np.asarray(Image.open(io.BytesIO(file), formats=("TIFF",)))


def _of_bytes(page: Any, data: bytes, which: Sequence[int], piece: tuple[int, int], size: tuple[int, int]) -> bytes:
    """A TIFF of some tiles or strips, one below the other: a grey picture, whose pixels are their bytes.

    A `piece` is so many bytes wide and so many rows high, and the picture is of this `size`.
    """
    pieces = [data[page.dataoffsets[k] : page.dataoffsets[k] + page.databytecounts[k]] for k in which]
    lengths = [len(one) for one in pieces]
    if sum(lengths) > len(data):
        raise ValueError("its tiles or strips overlap")
    places = itertools.accumulate(lengths[:-1], initial=_HEADER)
    fields: dict[int, tuple[int, ...]] = {
        256: (size[0],),
        257: (size[1],),
        258: (8,),
        259: (int(page.compression),),
        262: (1,),
        277: (1,),
    }
    if page.is_tiled:
        fields |= {322: (piece[0],), 323: (piece[1],), 324: tuple(places), 325: tuple(lengths)}
    else:
        fields |= {273: tuple(places), 278: (piece[1],), 279: tuple(lengths)}
    tables = page.jpegtables or b""
    entries = [(code, 4, len(values), struct.pack(f"<{len(values)}I", *values)) for code, values in fields.items()]
    entries += [(_JPEG_TABLES, 7, len(tables), tables)] * bool(tables)
    directory_at = _HEADER + sum(lengths) + sum(lengths) % 2
    array_at = directory_at + 2 + 12 * len(entries) + 4
    directory, arrays = struct.pack("<H", len(entries)), b""
    for code, kind, many, content in sorted(entries):
        if len(content) > 4:
            place = array_at + len(arrays)
            arrays += content + bytes(len(content) % 2)
            content = struct.pack("<I", place)
        directory += struct.pack("<HHI", code, kind, many) + content.ljust(4, b"\0")
    filling = bytes(sum(lengths) % 2)
    return b"".join([struct.pack("<2sHI", b"II", 42, directory_at), *pieces, filling, directory, bytes(4), arrays])


def _numbers(page: Any, pieces: UInt8[np.ndarray, "rows bytes"], samples: int) -> Shaped[np.ndarray, "*shape"]:
    """The numbers of unpacked bytes, without what a predictor did to them in each row of a piece."""
    order, size, rows = page.parent.byteorder, page.bitspersample // 8, len(pieces)
    pieces = np.ascontiguousarray(pieces)
    if page.predictor == _DIFFERENCES:
        whole = pieces.view(f"{order}u{size}").reshape(rows, -1, samples)
        pieces, order = np.cumsum(whole, axis=1, dtype=f"=u{size}").view(np.uint8), "="
    elif page.predictor == _FLOATING_POINT:  # the highest bytes of a row first, then the next ones
        whole = np.cumsum(pieces.reshape(rows, -1, samples), axis=1, dtype=np.uint8)
        pieces = np.ascontiguousarray(whole.reshape(rows, size, -1).swapaxes(1, 2))
        order = ">"
    flat = pieces.reshape(-1)
    if page.sampleformat == SAMPLEFORMAT.COMPLEXINT:
        pairs = flat.view(f"{order}i{size // 2}").reshape(-1, 2).astype(np.float64)
        return (pairs[:, 0] + 1j * pairs[:, 1]).astype(page.dtype)
    return flat.view(np.dtype(page.dtype).newbyteorder(order)).astype(page.dtype)


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
    with open_file(beside) as file:
        data = file.read()
    try:
        with TiffFile(io.BytesIO(data)) as other:
            return _absent(other.pages.first, data, page.shape[:2], str(beside), alone=True)
    except SarsplatError:
        raise
    except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        raise SarsplatError(f"{beside} is not a readable TIFF ({shown(str(error))}); write it again") from error


def _absent(
    mask: Any, data: bytes, shape: tuple[int, ...], name: str, *, alone: bool
) -> Bool[np.ndarray, "rows columns"]:
    if not alone or mask.shape != shape or math.prod(mask.chunks) > max(mask.size, _LARGEST_TILE):
        raise SarsplatError(f"{name} is not one of the pixels of the image; write that again, without it")
    absent: Bool[np.ndarray, "rows columns"] = pixels_of(mask, data, name) == 0
    return absent
