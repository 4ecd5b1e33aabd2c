"""Metadata and image segments of a SICD's NITF file, by jbpy."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.sarkit_xml import LONGEST_XML, plain_xml, sarkit_errors

if TYPE_CHECKING:
    import lxml.etree

_MAGICS = (b"NITF02.10", b"NSIF01.00")
_FILE_LENGTH_AT = 342  # bytes from the start

logging.getLogger("jbpy").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


@dataclass(frozen=True)
class Segment:
    """Some rows of an image, with their offset and length in the file, bytes."""

    offset: int
    length: int
    rows: int
    columns: int
    compressed: bool


def is_nitf(path: Path) -> bool:
    """Return whether a file begins as NITF files do."""
    with open_file(path) as file:
        return file.read(len(_MAGICS[0])) in _MAGICS


def read_nitf(path: Path, file: BinaryIO) -> tuple[lxml.etree._ElementTree, list[Segment]]:
    """Read the metadata of a SICD, and its image segments in their order.

    Raises if it is no NITF file, truncated or of another size than stated, holds no SICD, or its XML is not plain.
    """
    import jbpy

    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGICS[0])) not in _MAGICS:
        raise SarsplatError(
            f"{path} is not a NITF file of version 2.1, so it is not a SICD; give files of complex SAR images (SICD)"
        )
    file.seek(_FILE_LENGTH_AT)
    if (stated := file.read(12)) != b"%012d" % size:
        raise SarsplatError(f"{path} is truncated or too long: {size} bytes, but {shown(stated)} by its header")
    file.seek(0)
    with sarkit_errors(path):
        nitf: Any = jbpy.Jbp()
        nitf.load(file)
        images = sorted((one["subheader"]["IID1"].value, k, one) for k, one in enumerate(nitf["ImageSegments"]))
        extensions = [(one["DESDATA"].get_offset(), one["DESDATA"].size) for one in nitf["DataExtensionSegments"]]
        segments = [
            Segment(
                one["Data"].get_offset(),
                one["Data"].size,
                one["subheader"]["NROWS"].value,
                one["subheader"]["NCOLS"].value,
                one["subheader"]["IC"].value != "NC",
            )
            for name, _, one in images
            if name.startswith("SICD")
        ]
    for place, length in extensions:  # not always the first: sarpy puts others before it
        file.seek(place)
        text = file.read(min(length, LONGEST_XML))
        if b"urn:SICD:" in text[:4096]:
            return plain_xml(path, text, "SICD"), segments
    raise SarsplatError(f"{path} holds no metadata of a SICD; give files of complex SAR images (SICD)")
