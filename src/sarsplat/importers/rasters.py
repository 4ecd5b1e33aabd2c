"""Pictures in TIFFs and other rasters that GDAL reads, with their tags."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from jaxtyping import Bool, Complex64, Shaped

from sarsplat.data.csv_table import parsed
from sarsplat.data.files import open_file
from sarsplat.data.geotiff import KEYS, UNDEFINED, Georeference, georeference_of, opened_raster
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.columns import FACTORS
from sarsplat.names import Backscatter

TIFF = (".tif", ".tiff")
OTHERS = (".png", ".jpg", ".jpeg", ".npy", ".mat")
"""Endings of pictures that are read without GDAL."""
_SIDECAR = ".aux.xml"
_NORMALISATIONS: dict[str, Backscatter] = dict(beta_nought="beta0", sigma_nought="sigma0", gamma_nought="gamma0")
_STATED = re.compile(r'"(?:\w+:)?(scale_factor|calibration_factor|radiometry)"\s*:\s*"?([\w.+-]+)', re.IGNORECASE)
"""A factor or its normalisation in JSON, perhaps with a prefix."""
_FREE_VALUES, _VALUES_PER_BYTE = 4 << 20, 1032
"""Maximum number of values in a picture, or for each byte of its file (as DEFLATE packs zeros) if more."""
_MEANINGS = {274, 33550, 33922, 34264, KEYS, 42112, 42113}
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
    factors: tuple[tuple[str, float], ...] = ()
    """Producers' factors: meaning (of `FACTORS`) and number; more than one contradict each other."""
    backscatter: Backscatter | None = None
    """Normalisation of the power, if stated."""
    absent: Bool[np.ndarray, "rows columns"] | None = field(default=None, compare=False)
    """Pixels with the value of "no data", or left out by a mask or a band for transparency; None without such."""


def read_raster(path: Path) -> tuple[Shaped[np.ndarray, "*shape"], Tags]:
    """Read the only image of a file, [rows, columns] or [bands, rows, columns], and its tags."""
    if path.suffix.lower() in TIFF and (plain := _plain_tiff(path)) is not None:
        return plain
    with opened_raster(path) as file:
        refuse_bomb(path, file.width * file.height * file.count)
        _require_plain(path, file)
        bands = [k for k, kind in zip(file.indexes, file.colorinterp, strict=True) if kind.name != "alpha"]
        masks = file.read_masks(bands)
        if ((masks != 0) & (masks != 255)).any():
            raise SarsplatError(f"{path} has pixels that are transparent in part; write it without its alpha band")
        absent, pixels = (masks == 0).any(axis=0), file.read(bands)
        tags = Tags(georeference_of(file), absent=absent if absent.any() else None, **_scaling(path, file, bands))
    return pixels[0] if len(pixels) == 1 else pixels, tags


def refuse_bomb(path: Path, values: int) -> None:
    """Raise if a picture unpacks to more than its file can hold."""
    size = path.stat().st_size
    if values > max(_FREE_VALUES, _VALUES_PER_BYTE * size):
        raise SarsplatError(f"{path} has {size} bytes but claims to hold {values} values; save it without compression")


def sidecar_scaling(path: Path) -> Tags:
    """Return what NAME.png.aux.xml says of a picture NAME.png, or the JSON beside it unless it is an array."""
    sidecar = path.with_name(path.name + _SIDECAR)
    if not sidecar.exists() or not re.search(rb"<Scale>|<Offset>|_factor", sidecar.read_bytes()):
        return Tags() if path.suffix.lower() in (".npy", ".mat") else Tags(**_calibration(path, ""))
    with opened_raster(path) as file:
        return Tags(**_scaling(path, file, file.indexes))


def _scaling(path: Path, file: Any, bands: Iterable[int]) -> dict[str, Any]:
    """Return scale, offset and producers' factors of an open raster, by their names in `Tags`."""
    stated = {(file.scales[k - 1], file.offsets[k - 1]) for k in bands}
    if len(stated) > 1 or not np.isfinite([*stated]).all():
        raise SarsplatError(
            f"{path} names {shown(sorted(stated))} as scale and offset; give finite ones, equal in all bands"
        )
    ((scale, offset),) = stated
    tags = "\n".join(f'"{name}": "{text}"' for name, text in file.tags().items())
    return {"scale": scale, "offset": offset, **_calibration(path, tags)}


def _calibration(path: Path, text: str) -> dict[str, Any]:
    """Return producers' factors and the normalisation of the power, by tags or the JSON of a description or beside."""
    for beside in (path.with_suffix(".json"), path.with_name(f"{path.stem}_extended.json")):
        if beside.is_file():
            with open_file(beside) as file:
                text += file.read().decode("utf-8", "replace")
    stated = {(name.lower().replace("_", "-"), value.lower()) for name, value in _STATED.findall(text)}
    numbers = {(name, parsed(value)) for name, value in stated if name in FACTORS}
    kind = {_NORMALISATIONS.get(value) for name, value in stated if name == "radiometry"} or {None}
    return {
        "factors": tuple(sorted((name, number) for name, number in numbers if 1e-15 <= number <= 1e15)),
        "backscatter": kind.pop() if len(kind) == 1 else None,
    }


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


def _plain_tiff(path: Path) -> tuple[Shaped[np.ndarray, "rows columns"], Tags] | None:
    """Read the only band of an uncompressed TIFF without special tags; None if GDAL has to read it."""
    if any(path.with_name(path.name + ending).exists() for ending in (".msk", _SIDECAR)):
        return None
    with open_file(path) as file:
        size = path.stat().st_size
        try:
            with tifffile.TiffFile(file) as tiff:
                page: Any = tiff.pages.first
                halves = (page.sampleformat, page.bitspersample) == (6, 32)  # complex, which numpy has no type for
                bits = 32 if halves else 8 * np.dtype(page.dtype).itemsize
                plain = (page.compression, page.photometric, page.samplesperpixel) == (1, 1, 1)
                if len(tiff.pages) > 1 or not plain or page.bitspersample != bits or page.size * bits > 8 * size:
                    return None
                if halves and page.is_tiled:
                    return None
                if _MEANINGS & {tag.code for tag in page.tags.values()} or page.sampleformat == UNDEFINED:
                    return None
                pixels, description = _halves(file, page) if halves else page.asarray(), page.description
        except Exception:  # a garbled TIFF can fail anywhere inside the parser, with any exception
            return None
    return pixels, Tags(**_calibration(path, description))


def _halves(file: BinaryIO, page: Any) -> Complex64[np.ndarray, "rows columns"]:
    """Read an uncompressed image of complex numbers whose parts are 16-bit floats, in strips."""
    data = b""
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        file.seek(offset)
        data += file.read(count)
    parts = np.frombuffer(data, f"{page.parent.byteorder}f2").reshape(*page.shape, 2).astype(np.float32)
    return parts.view(np.complex64)[..., 0]


def _require_plain(path: Path, file: Any) -> None:
    """Raise if the pixels are not plain measured values: several pages or polarisations, inverted or a palette."""
    channels = [_CHANNEL.search(name or "") for name in file.descriptions]
    polarisations = [*dict.fromkeys(channel[0].upper() for channel in channels if channel)]
    several = f"has bands of several polarisations ({', '.join(polarisations)})"
    white_zero = file.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES"
    palette = any(kind.name == "palette" for kind in file.colorinterp)
    problems = {
        "has several pages; give one image for each file": bool(file.subdatasets),
        f"{several}; give one in each file, as by gdal_translate -b 1": len(polarisations) > 1,
        f"has {file.count} bands; give one, or two: the real and the imaginary part": file.count > 3,
        "says that zero is white; write it again with black as zero": white_zero,
        "holds numbers of colours in a palette; give the measured values, in grey": palette,
    }
    for problem, found in problems.items():
        if found:
            raise SarsplatError(f"{path} {problem}")
