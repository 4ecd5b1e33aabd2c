"""What a NITF file holds of a SICD: its metadata, as plain XML, and where its pixels lie.

The files come from strangers: lengths must add up to the file's, and the XML must be plain.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    import lxml.etree

_MAGICS = (b"NITF02.10", b"NSIF01.00")
_FILE_LENGTH = slice(342, 354)  # bytes of the header that state it
_LONGEST_XML = 4 << 20
_HIGHEST_ORDER = 20
_OTHERS = {
    b"CPHD": "phase history (CPHD)",
    b"CRSD": "raw radar data (CRSD)",
    b"II*\0": "a TIFF picture",
    b"MM\0*": "a TIFF picture",
    b"\x89HDF": "an HDF5 file",
}


@dataclass(frozen=True)
class Segment:
    """Some rows of an image: where they begin in the file, and how many bytes they have there."""

    offset: int
    length: int
    rows: int
    columns: int
    compressed: bool


def read_nitf(path: Path, file: BinaryIO) -> tuple[lxml.etree._ElementTree, list[Segment]]:
    """The metadata of a SICD, without entities or references to other files, and its image segments in their order.

    Raises
    ------
    SarsplatError
        If it is no NITF file, is truncated or states lengths that contradict its size, holds no SICD, or its XML is
        garbled or not plain.
    """
    import jbpy

    size = file.seek(0, 2)
    file.seek(0)
    head = file.read(_FILE_LENGTH.stop)
    if not head.startswith(_MAGICS):
        kind = next((words for magic, words in _OTHERS.items() if head.startswith(magic)), None)
        raise SarsplatError(
            f"{path} is {kind or 'not a NITF file'}, so it is not a SICD; give files of complex SAR images (SICD)"
        )
    stated = head[_FILE_LENGTH]
    if stated.isdigit() and int(stated) != size:
        state = "is truncated" if size < int(stated) else "is too long"
        raise SarsplatError(f"{path} {state}: {size} bytes where its header says {int(stated)}; get it again")
    file.seek(0)
    with sarkit_errors(path):
        nitf = jbpy.Jbp().load(file)  # type: ignore[arg-type]
        extensions = [part["DESDATA"] for part in nitf["DataExtensionSegments"]]
        images = [part for part in nitf["ImageSegments"] if part["subheader"]["IID1"].value.startswith("SICD")]
        images.sort(key=lambda part: part["subheader"]["IID1"].value)
        segments = [
            Segment(
                part["Data"].get_offset(),
                part["Data"].size,
                part["subheader"]["NROWS"].value,
                part["subheader"]["NCOLS"].value,
                part["subheader"]["IC"].value != "NC",
            )
            for part in images
        ]
        place, length = (extensions[0].get_offset(), extensions[0].size) if extensions else (0, 0)
    if not extensions:
        raise SarsplatError(f"{path} is a NITF file without metadata in XML, so it is not a SICD; give SICD files")
    if max([place + length, *(part.offset + part.length for part in segments)]) > size:
        raise SarsplatError(f"{path} has a header whose lengths do not fit its size; get it again")
    if length > _LONGEST_XML:
        raise SarsplatError(
            f"{path} has {length} bytes of metadata, where SICDs have at most {_LONGEST_XML}; get it again"
        )
    file.seek(place)
    return _plain_xml(path, file.read(length)), segments


def _plain_xml(path: Path, text: bytes) -> lxml.etree._ElementTree:
    import lxml.etree

    plain = lxml.etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        tree = lxml.etree.fromstring(text, plain).getroottree()
    except (lxml.etree.LxmlError, ValueError) as error:
        raise SarsplatError(
            f"{path} has metadata that are not valid XML ({shown(str(error))}); get it again"
        ) from error
    if tree.docinfo.doctype or tree.docinfo.internalDTD is not None:
        raise SarsplatError(f"{path} has a DOCTYPE in its XML, which no SICD has, and is not read; get it elsewhere")
    name = str(tree.getroot().tag)
    if not name.startswith("{urn:SICD:") or not name.endswith("}SICD"):
        if "SIDD" in name:
            raise SarsplatError(f"{path} is a SIDD, a picture derived from SAR images; give the SICD it was made from")
        raise SarsplatError(f"{path} holds {shown(name)}, not a SICD; give files of complex SAR images (SICD)")
    for element in tree.iter("{*}Coef"):  # sarkit makes an array as large as the highest exponents say
        for power in (element.get(name, "0") for name in ("exponent1", "exponent2")):
            if not (power.isascii() and power.isdigit() and int(power[:9]) <= _HIGHEST_ORDER):
                raise SarsplatError(
                    f"{path} has a polynomial with the exponent {shown(power)}; at most {_HIGHEST_ORDER} is plausible, "
                    "so get it again"
                )
    return tree


@contextmanager
def sarkit_errors(path: Path) -> Iterator[None]:
    """One sentence in place of whatever sarkit and jbpy raise, which trust their files; their warnings are hidden."""
    log = logging.getLogger("jbpy")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (SarsplatError, OSError, MemoryError):
        raise
    except Exception as error:
        problem = shown(f"{type(error).__name__}: {error}")
        raise SarsplatError(f"{path} is not a valid SICD (sarkit says {problem}); get it again") from error
    finally:
        log.setLevel(level)
