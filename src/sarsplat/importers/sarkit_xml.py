"""Metadata of SICD and CPHD files: untrusted XML, whose elements sarkit reads, and the NITF of SICDs, by jbpy."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.files import printable, raise_damaged

if TYPE_CHECKING:
    import lxml.etree

LONGEST_XML = 4 << 20
"""Maximum size of metadata, bytes."""
_HIGHEST_ORDER = 20
_NITF_MAGICS = (b"NITF02.10", b"NSIF01.00")
_FILE_LENGTH_AT = 342  # bytes from the start
_FIELDS = ("NROWS", "NCOLS", "IC")

logging.getLogger("jbpy").setLevel(logging.CRITICAL)  # what is wrong with a file is said by our own errors


@dataclass(frozen=True)
class Metadata:
    """Metadata of one file of any version; elements are named by their path, such as "Grid/Row/SS"."""

    path: Path
    tree: lxml.etree._ElementTree

    def text(self, name: str) -> str:
        """Return the printable text of an element; "" if it is missing."""
        return printable(self.tree.findtext(any_version(name)))


def any_version(name: str) -> str:
    """Return a path of elements of any namespace, which differs between versions."""
    return "/".join("{*}" + part for part in name.split("/"))


def plain_xml(path: Path, text: bytes, kind: str) -> lxml.etree._ElementTree:
    """Parse the XML of a SICD or another `kind` without resolving entities; raise for a DOCTYPE or absurd exponents."""
    import lxml.etree

    plain = lxml.etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        tree = lxml.etree.fromstring(text, plain).getroottree()
    except (lxml.etree.LxmlError, ValueError) as error:
        raise_damaged(path, f"has metadata that are not valid XML ({shown(str(error))})")
    if tree.docinfo.doctype or tree.docinfo.internalDTD is not None:
        raise SarsplatError(f"{path} has a DOCTYPE in its XML, which no {kind} has, and is not read; get it elsewhere")
    for element in tree.iter("{*}Coef"):  # sarkit makes an array as large as the highest exponents say
        for power in (element.get(name, "0") for name in ("exponent1", "exponent2")):
            if not (power.isascii() and power.isdigit() and int(power[:9]) <= _HIGHEST_ORDER):
                raise_damaged(path, f"has a polynomial with the exponent {shown(power)}, more than {_HIGHEST_ORDER}")
    return tree


@contextmanager
def sarkit_errors(path: Path, kind: str = "SICD") -> Iterator[None]:
    """Turn any exception of sarkit, which trusts its files, into one sentence, and hide its warnings."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (SarsplatError, OSError, MemoryError):
        raise
    except Exception as error:
        raise_damaged(path, f"is not a valid {kind} (sarkit says {shown(f'{type(error).__name__}: {error}')})")


@dataclass(frozen=True)
class Segment:
    """Some rows of an image, with their offset and length in the file, bytes."""

    offset: int
    length: int
    rows: int
    columns: int
    compression: str


def is_nitf(path: Path) -> bool:
    """Return whether a file begins as NITF files do."""
    with open_file(path) as file:
        return file.read(len(_NITF_MAGICS[0])) in _NITF_MAGICS


def _few_bands(name: str) -> Any:
    """Return jbpy's image segment, but blind to more than nine bands, which take it minutes; a SICD has two."""
    from jbpy.core import ImageSegment

    segment: Any = ImageSegment(name)
    segment["subheader"]._xbands_handler = None
    return segment


def read_nitf(path: Path, file: BinaryIO) -> tuple[lxml.etree._ElementTree, list[Segment]]:
    """Read the metadata of a SICD, and its image segments in their order.

    Raises if it is no NITF file, truncated or of another size than stated, holds no SICD, or its XML is not plain.
    """
    import jbpy

    size = path.stat().st_size
    if file.read(len(_NITF_MAGICS[0])) not in _NITF_MAGICS:
        raise SarsplatError(f"{path} is not a NITF file of version 2.1, so it is not a SICD; give SICD files")
    file.seek(_FILE_LENGTH_AT)
    if (stated := file.read(12)) != b"%012d" % size:
        raise_damaged(path, f"is truncated or too long: {size} bytes, but {shown(stated)} by its header")
    file.seek(0)
    with sarkit_errors(path):
        nitf: Any = jbpy.Jbp()
        nitf["ImageSegments"].field_creator = _few_bands
        nitf.load(file)
        images = sorted((one["subheader"]["IID1"].value, k, one) for k, one in enumerate(nitf["ImageSegments"]))
        extensions = [(one["DESDATA"].get_offset(), one["DESDATA"].size) for one in nitf["DataExtensionSegments"]]
        segments = [
            Segment(one["Data"].get_offset(), one["Data"].size, *(one["subheader"][name].value for name in _FIELDS))
            for name, _, one in images
            if name.startswith("SICD")
        ]
    for place, length in extensions:  # not always the first: sarpy puts others before it
        file.seek(place)
        text = file.read(min(length, LONGEST_XML))
        if b"urn:SICD:" in text[:4096]:
            return plain_xml(path, text, "SICD"), segments
    raise SarsplatError(f"{path} holds no metadata of a SICD; give SICD files")
