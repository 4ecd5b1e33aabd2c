"""Pictures in TIFFs and other rasters that GDAL reads, with their tags."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Bool, Shaped

from sarsplat.data.files import open_file
from sarsplat.data.geotiff import Georeference, georeference_of, opened_raster
from sarsplat.errors import SarsplatError

TIFF = (".tif", ".tiff")
OTHERS = (".png", ".jpg", ".jpeg", ".npy", ".mat")
"""Endings of pictures that are read without GDAL."""
_GEO_KEYS = 34735
_MEANINGS = {274, 33550, 33922, 34264, _GEO_KEYS, 42112, 42113}
"""Tags of orientation, places, scales and "no data"."""
_CHANNEL = re.compile(r"(?<![a-z])[hv][hv](?![a-z])", re.IGNORECASE)
"""A polarisation in the name of a band, such as Sigma0_VV."""


@dataclass(frozen=True)
class Tags:
    """Tags of a file about its pixels."""

    georeference: Georeference | None = None
    scale: float = 1.0
    """Factor on the pixels."""
    offset: float = 0.0
    """Number added after that."""
    absent: Bool[np.ndarray, "rows columns"] | None = field(default=None, compare=False)
    """Pixels with the value of "no data", or left out by a mask or a band for transparency; None without such."""


def read_raster(path: Path) -> tuple[Shaped[np.ndarray, "*shape"], Tags]:
    """Read the only image of a file, [rows, columns] or [bands, rows, columns], and its tags."""
    if path.suffix.lower() in TIFF and (pixels := _plain_tiff(path)) is not None:
        return pixels, Tags()
    with opened_raster(path) as file:
        _require_plain(path, file)
        bands = [k for k, kind in zip(file.indexes, file.colorinterp, strict=True) if kind.name != "alpha"]
        masks = file.read_masks(bands)
        if ((masks != 0) & (masks != 255)).any():
            raise SarsplatError(f"{path} has pixels that are transparent in part; write it without its alpha band")
        absent = (masks == 0).any(axis=0)
        pixels = file.read(bands)
        tags = Tags(georeference_of(file), file.scales[0], file.offsets[0], absent if absent.any() else None)
    if not np.isfinite([tags.scale, tags.offset]).all():
        raise SarsplatError(f"{path} names {tags.scale}, {tags.offset} as scale and offset; give finite ones")
    return pixels[0] if len(pixels) == 1 else pixels, tags


def first_georeference(paths: Iterable[Path]) -> Georeference | None:
    """Return the georeference of the first readable raster among files, or None."""
    for path in paths:
        if path.suffix.lower() not in (*OTHERS, ".csv") and path.is_file():
            try:
                with opened_raster(path) as file:
                    found = georeference_of(file)
            except SarsplatError:
                continue
            if found is not None:
                return found
    return None


def _plain_tiff(path: Path) -> Shaped[np.ndarray, "rows columns"] | None:
    """Read the only band of an uncompressed TIFF without special tags; None if GDAL has to read it."""
    if any(path.with_name(path.name + ending).exists() for ending in (".msk", ".aux.xml")):
        return None
    with open_file(path) as file:
        size = file.seek(0, 2)
        file.seek(0)
        try:
            with tifffile.TiffFile(file) as tiff:
                page: Any = tiff.pages.first
                bits = 8 * np.dtype(page.dtype).itemsize
                plain = (page.compression, page.photometric, page.samplesperpixel) == (1, 1, 1)
                if len(tiff.pages) > 1 or not plain or page.bitspersample != bits or page.size * bits > 8 * size:
                    return None
                return None if _MEANINGS & {tag.code for tag in page.tags.values()} else page.asarray()
        except Exception:  # a garbled TIFF can fail anywhere inside the parser, with any exception
            return None


def _require_plain(path: Path, file: Any) -> None:
    """Raise if the pixels are not plain measured values: several pages or polarisations, inverted or a palette."""
    channels = [_CHANNEL.search(name or "") for name in file.descriptions]
    polarisations = [*dict.fromkeys(channel[0].upper() for channel in channels if channel)]
    for wrong, problem in (
        (bool(file.subdatasets), "has several pages; give one image for each file"),
        (
            len(polarisations) > 1,
            f"has bands of several polarisations ({', '.join(polarisations)}); give one in each file, as by "
            "gdal_translate -b 1",
        ),
        (
            file.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES",
            "says that zero is white; write it again with black as zero",
        ),
        (
            any(kind.name == "palette" for kind in file.colorinterp),
            "holds numbers of colours in a palette; give the measured values, in grey",
        ),
    ):
        if wrong:
            raise SarsplatError(f"{path} {problem}")
