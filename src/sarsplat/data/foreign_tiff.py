"""TIFFs that other programs wrote: opened without trust, the numbers of their tags, and what GDAL says in one."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tifffile

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown

PIXEL_SCALE, TIEPOINT, TRANSFORMATION = 33550, 33922, 34264
KEYS, DOUBLES, TEXTS = 34735, 34736, 34737
GDAL_METADATA, NO_DATA = 42112, 42113

PageTags = Mapping[int, Any]
"""What a page says of itself: number of the tag → value."""


@contextmanager
def opened_tiff(path: Path, how: str) -> Iterator[tuple[tifffile.TiffFile, bytes]]:
    """A TIFF and its bytes; whatever fails with it becomes one sentence, which says `how` to write it again."""
    with open_file(path) as file:
        data = file.read()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            yield tiff, data
    except SarsplatError:
        raise
    except Exception as error:  # a garbled TIFF can fail anywhere inside the parser, with any exception
        raise SarsplatError(f"{path} is not a readable TIFF ({shown(str(error))}); write it again{how}") from error


def tags_of(page: Any) -> PageTags:
    """The tags of tifffile's `page`."""
    return {tag.code: tag.value for tag in page.tags.values()}


def gdal_items(tags: PageTags, role: str) -> list[str]:
    """What GDAL's metadata say of the bands, such as their scale."""
    return re.findall(rf'<Item[^<>]*role="{role}"[^<>]*>([^<>]*)</Item>', str(tags.get(GDAL_METADATA, "")))
