"""Pixels of a TIFF that someone else wrote, and the tags that change what they mean."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Bool, Shaped

from sarsplat.data.foreign_tiff import NO_DATA, PageTags, gdal_items, opened_tiff, tags_of
from sarsplat.data.georeference import Georeference, georeference_of
from sarsplat.data.packed_tiff import masked_out, pixels_of
from sarsplat.errors import SarsplatError, shown

TIFF = (".tif", ".tiff")
_MOST_PAGES = 16
_PHOTOMETRIC, _ORIENTATION = 262, 274
_WHITE_IS_ZERO, _PALETTE = 0, 3
_OPAQUE = 255
"""In bands for transparency that GDAL writes beside numbers with a sign or a fraction."""
_CHANNEL = re.compile(r"(?<![a-z])[hv][hv](?![a-z])", re.IGNORECASE)
"""A polarisation in the name of a band, such as Sigma0_VV."""
_FREE_BYTES, _BYTES_PER_BYTE = 4 << 20, 64
"""Measured images do not compress much: what unpacks to more than this, and so many times its size, is a bomb."""


@dataclass(frozen=True)
class Tags:
    """What a file says of its pixels beside their values; usually nothing.

    Parameters
    ----------
    georeference : Georeference or None
        Where they lie.
    no_data : float or None
        The value of pixels that were not measured.
    scale, offset : float or None
        What they are multiplied by, and what is then added, to be what they stand for.
    white_is_zero : bool
        Brighter ones had smaller numbers, which was mended.
    absent : numpy.ndarray, bool [rows, columns], or None
        Pixels that a mask or a band for transparency leaves out; None if neither does.
    """

    georeference: Georeference | None = None
    no_data: float | None = None
    scale: float | None = None
    offset: float | None = None
    white_is_zero: bool = False
    absent: Bool[np.ndarray, "rows columns"] | None = field(default=None, compare=False)


def unknown(pixels: Shaped[np.ndarray, "*shape"], tags: Tags) -> Bool[np.ndarray, "*shape"]:
    """Pixels that hold the value of what was not measured, or are left out by a mask."""
    missing = np.zeros(pixels.shape, bool)
    if tags.absent is not None:
        missing |= tags.absent if pixels.ndim == 2 or pixels.shape[0] == 2 else tags.absent[..., None]
    no_data = tags.no_data
    if no_data is None:
        return missing
    if math.isnan(no_data):
        return missing | np.isnan(pixels)
    # as its own type holds it: −3.4028234663852886e38 is float32's lowest
    with np.errstate(over="ignore"):
        return missing | (pixels == (pixels.dtype.type(no_data) if pixels.dtype.kind in "fc" else no_data))


def read_tiff_of_others(path: Path) -> tuple[Shaped[np.ndarray, "*shape"], Tags]:
    """The pixels of the one image in a file, and its tags; of overviews nothing is read."""
    with opened_tiff(path, ", without compression") as (tiff, data):
        page = _the_page(path, tiff)
        tags = tags_of(page)
        _refuse_meanings(path, page, tags)
        packed = page.compression != tifffile.COMPRESSION.NONE
        whole, part = (_unpacked_bytes(page, shape, packed) for shape in (page.shape, page.chunks))
        refuse_bomb(path, max(whole, part), len(data), packed)
        pixels, absent = _without_alpha(path, page, pixels_of(page, data, str(path)))
        if (masked := masked_out(tiff, page, data, path)) is not None:
            absent = masked
    if absent is not None and not absent.any():
        absent = None
    return _black_is_zero(path, pixels, page, tags), replace(_tags(path, page, tags), absent=absent)


def first_georeference(paths: Iterable[Path]) -> Georeference | None:
    """Where the pixels of the first TIFF among files lie, by its tags; what cannot be read says nothing."""
    first = next((path for path in paths if path.suffix.lower() in TIFF and path.is_file()), None)
    try:
        return None if first is None else read_tiff_of_others(first)[1].georeference
    except SarsplatError:
        return None


def refuse_bomb(path: Path, unpacked: int, size: int, packed: bool) -> None:
    """Refuse a file that claims to hold far more than it can."""
    if unpacked > (max(_FREE_BYTES, _BYTES_PER_BYTE * size) if packed else size):
        raise SarsplatError(
            f"{path} has {size} bytes but claims to hold {unpacked}; it is damaged or no measured image: write it "
            "again, without compression"
        )


def _the_page(path: Path, tiff: tifffile.TiffFile) -> Any:
    pages_read = [page.aspage() for page in itertools.islice(tiff.pages, _MOST_PAGES)]
    pages = [page for page in pages_read if not page.is_reduced and not page.is_mask]
    if len(pages) != 1:
        what = "several pages" if pages else "no image in it"
        raise SarsplatError(f"{path} has {what}; give one image for each file")
    return pages[0]


def _without_alpha(
    path: Path, page: Any, pixels: Shaped[np.ndarray, "*shape"]
) -> tuple[Shaped[np.ndarray, "*fewer"], Bool[np.ndarray, "rows columns"] | None]:
    """The pixels without a band for transparency, and where that leaves them out."""
    if not {tifffile.EXTRASAMPLE.ASSOCALPHA, tifffile.EXTRASAMPLE.UNASSALPHA} & set(page.extrasamples):
        return pixels, None
    axis = 0 if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE else 2
    alpha = np.take(pixels, -1, axis) if pixels.ndim == 3 else pixels
    opaque = _white(page) if pixels.dtype.kind == "u" else _OPAQUE
    if len(page.extrasamples) != 1 or not {*np.unique(alpha).tolist()} <= {0, opaque}:
        raise SarsplatError(
            f"{path} has a band for transparency in which pixels are partly seen, which is not read; save it again "
            "without transparency"
        )
    others = np.delete(pixels, -1, axis)
    return (others.squeeze(axis) if others.shape[axis] == 1 else others), alpha == 0


def _unpacked_bytes(page: Any, shape: tuple[int, ...], packed: bool) -> int:
    """Bytes that so many numbers take; if they are not packed, in the file, where they may be shorter."""
    bits = 8 * np.dtype(page.dtype).itemsize if packed else int(page.bitspersample)
    return math.prod(shape) * bits // 8


def _refuse_meanings(path: Path, page: Any, tags: PageTags) -> None:
    """Refuse what would be read as something else than it is."""
    channels = [_CHANNEL.search(name) for name in gdal_items(tags, "description")]
    polarisations = [*dict.fromkeys(channel[0].upper() for channel in channels if channel)]
    if page.samplesperpixel > 1 and len(polarisations) > 1:
        raise SarsplatError(
            f"{path} has bands of several polarisations ({', '.join(polarisations)}); give one in each file, as by "
            "gdal_translate -b 1"
        )
    if tags.get(_PHOTOMETRIC) == _PALETTE:
        raise SarsplatError(f"{path} holds numbers of colours in a palette; give the measured values, in grey")
    if (orientation := int(tags.get(_ORIENTATION, 1))) != 1:
        raise SarsplatError(
            f"{path} says that it is to be turned or mirrored before it is shown (orientation {orientation}); "
            "save it as it is to be seen, with orientation 1"
        )


def _black_is_zero(
    path: Path, pixels: Shaped[np.ndarray, "*shape"], page: Any, tags: PageTags
) -> Shaped[np.ndarray, "*shape"]:
    """Brighter pixels have larger numbers, whichever way the file has it."""
    if tags.get(_PHOTOMETRIC) != _WHITE_IS_ZERO or page.samplesperpixel != 1:
        return pixels
    if pixels.dtype.kind != "u":
        raise SarsplatError(
            f"{path} says that zero is white (photometric interpretation 0), which {pixels.dtype} numbers are not "
            "measured by; write it again with black as zero"
        )
    inverted: Shaped[np.ndarray, "*shape"] = (_white(page) - pixels).astype(pixels.dtype)
    return inverted


def _white(page: Any) -> int:
    return (1 << int(page.bitspersample)) - 1


def _tags(path: Path, page: Any, tags: PageTags) -> Tags:
    no_data = None
    if NO_DATA in tags:
        try:
            no_data = float(tags[NO_DATA])
        except (TypeError, ValueError) as error:
            raise SarsplatError(
                f"{path} names the value of pixels without data as {shown(tags[NO_DATA])}; give a number"
            ) from error
        if tags.get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
            no_data = _white(page) - no_data
    scale, offset = (_item(path, tags, role) for role in ("scale", "offset"))
    inverted = tags.get(_PHOTOMETRIC) == _WHITE_IS_ZERO
    return Tags(georeference_of(tags, str(path)), no_data, scale, offset, inverted)


def _item(path: Path, tags: PageTags, role: str) -> float | None:
    """What GDAL's metadata say of the first band."""
    items = gdal_items(tags, role)
    if not items:
        return None
    try:
        value = float(items[0])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SarsplatError(
            f"{path} names {shown(items[0])} as the {role} of its numbers; write it again with a finite one"
        )
    return value
