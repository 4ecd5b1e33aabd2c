"""Reads from a NITF file the XML metadata of a SICD and where its image segments lie.

A NITF 2.1 file is a header, which states the length of every part, followed by the parts: segments of image, graphics,
text, data extensions and reserved extensions, each with a header of its own. The files come from strangers: lengths
must add up to the file's, and the XML must be plain.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NoReturn

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.sarkit_xml import LONGEST_XML, plain_xml

if TYPE_CHECKING:
    import lxml.etree

_MAGICS = (b"NITF02.10", b"NSIF01.00")
_FILE_LENGTH_AT = 342  # bytes from the start
_ROWS_AT, _CORNERS_AT = 333, 372  # bytes from the start of an image segment's header
_KINDS = (
    ("image", 6, 10),
    ("graphic", 4, 6),
    ("nothing", 0, 0),
    ("text", 4, 5),
    ("data extension", 4, 9),
    ("reserved", 4, 7),
)
"""Kinds of segments in the order of the header, with digits of the lengths of a segment's header and data."""
_MOST_SEGMENTS = 100
_XML_EXTENSIONS = ("XML_DATA_CONTENT", "SICD_XML", "SIDD_XML")
_START_OF_XML = 4096  # in which the root is
_OTHERS = {
    b"NITF": "a NITF file of another version than 2.1",
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


def is_nitf(path: Path) -> bool:
    """Whether a file begins as NITF files do."""
    with open_file(path) as file:
        return file.read(len(_MAGICS[0])) in _MAGICS


def read_nitf(path: Path, file: BinaryIO) -> tuple[lxml.etree._ElementTree, list[Segment]]:
    """The metadata of a SICD, without entities or references to other files, and its image segments in their order.

    Refused if it is no NITF file, is truncated or states lengths that contradict its size, holds no SICD, or its XML is
    garbled or not plain.
    """
    size = file.seek(0, 2)
    file.seek(0)
    head = file.read(9)
    if head not in _MAGICS:
        kind = next((words for magic, words in _OTHERS.items() if head.startswith(magic)), None)
        raise SarsplatError(
            f"{path} is {kind or 'not a NITF file'}, so it is not a SICD; give files of complex SAR images (SICD)"
        )
    numbers = _Numbers(path, file)
    stated = numbers.at(_FILE_LENGTH_AT, 12)
    if stated != size:
        state = "is truncated" if size < stated else "is too long"
        raise SarsplatError(f"{path} {state}: {size} bytes where its header says {stated}; get it again")
    parts = _parts(numbers, size)
    if not parts["data extension"]:
        raise SarsplatError(f"{path} is a NITF file without metadata in XML, so it is not a SICD; give SICD files")
    place, subheader, length = _with_metadata(numbers, parts["data extension"])
    if length > LONGEST_XML:
        raise SarsplatError(
            f"{path} has {length} bytes of metadata, where SICDs have at most {LONGEST_XML}; get it again"
        )
    file.seek(place + subheader)
    tree = _sicd_xml(path, file.read(length))
    images = [(numbers.text_at(part[0] + 2, 10), part) for part in parts["image"]]
    return tree, [_segment(numbers, *part) for name, part in sorted(images) if name.startswith("SICD")]


def _with_metadata(numbers: _Numbers, extensions: list[tuple[int, int, int]]) -> tuple[int, int, int]:
    """The data extension that holds the metadata; that is not always the first: sarpy puts others before it."""
    for place, subheader, length in extensions:
        start = numbers.text_at(place + subheader, min(length, _START_OF_XML))
        if numbers.text_at(place + 2, 25).strip() in _XML_EXTENSIONS and re.search(r"urn:SI[CD]D:", start):
            return place, subheader, length
    return extensions[0]


def _parts(numbers: _Numbers, size: int) -> dict[str, list[tuple[int, int, int]]]:
    """Segments by their kind: where each begins, and how long its header and its data are; they fill the file."""
    place = numbers.next(6)
    end_of_header, parts = place, {}
    for kind, header_digits, data_digits in _KINDS:
        count = numbers.next(3)
        if count > _MOST_SEGMENTS or (kind == "nothing" and count):
            numbers.contradict()
        parts[kind] = [(0, numbers.next(header_digits), numbers.next(data_digits)) for _ in range(count)]
    if numbers.place > end_of_header:
        numbers.contradict()
    for segments in parts.values():
        for index, (_, header, data) in enumerate(segments):
            segments[index] = place, header, data
            place += header + data
    if place != size:
        numbers.contradict()
    return parts


def _segment(numbers: _Numbers, place: int, header: int, length: int) -> Segment:
    """An image segment, from the fields of its header; those after the corners depend on what is there before."""
    rows, columns = numbers.at(place + _ROWS_AT, 8), numbers.next(8)
    comments = place + _CORNERS_AT + (60 if numbers.text_at(place + _CORNERS_AT - 1, 1).strip() else 0)
    compression = numbers.text_at(comments + 1 + 80 * numbers.at(comments, 1), 2)
    return Segment(place + header, length, rows, columns, compression != "NC")


class _Numbers:
    """Reads fixed-width decimal numbers and text from a file's headers."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file

    @property
    def place(self) -> int:
        """Bytes from the start of the file."""
        return self._file.tell()

    def at(self, place: int, digits: int) -> int:
        self._file.seek(place)
        return self.next(digits)

    def next(self, digits: int) -> int:
        text = self._file.read(digits)
        if len(text) != digits or not text.isdigit():
            self.contradict()
        return int(text)

    def text_at(self, place: int, length: int) -> str:
        self._file.seek(place)
        return self._file.read(length).decode("latin-1")

    def contradict(self) -> NoReturn:
        """Raise the error for a header that cannot be right."""
        raise SarsplatError(f"{self._path} has a header whose lengths do not fit its size; get it again")


def _sicd_xml(path: Path, text: bytes) -> lxml.etree._ElementTree:
    tree = plain_xml(path, text, "SICD")
    name = str(tree.getroot().tag)
    if not name.startswith("{urn:SICD:") or not name.endswith("}SICD"):
        if "SIDD" in name:
            raise SarsplatError(f"{path} is a SIDD, a picture derived from SAR images; give the SICD it was made from")
        raise SarsplatError(f"{path} holds {shown(name)}, not a SICD; give files of complex SAR images (SICD)")
    return tree
