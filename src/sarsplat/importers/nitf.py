"""What a NITF file says of itself, held against its size before anything in it is believed.

A NITF 2.1 file is a header, which states the length of every part, followed by the parts: segments of image, graphics,
text, data extensions and reserved extensions, each with a header of its own. The metadata of a SICD are XML in the
first data extension. The files come from strangers: lengths must add up to the file's, and the XML must be plain.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NoReturn

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    import lxml.etree

_MAGICS = (b"NITF02.10", b"NSIF01.00")
_FILE_LENGTH_AT = 342  # bytes from the start; 12 digits
_PARTS = (
    ("image", 6, 10),
    ("graphic", 4, 6),
    (None, 0, 0),
    ("text", 4, 5),
    ("data extension", 4, 9),
    ("reserved", 4, 7),
)
"""Kinds of segments in the order of the header, with digits of the lengths of a segment's header and data."""
_LONGEST_XML = 4 << 20
_MOST_SEGMENTS = 100
_HIGHEST_ORDER = 20
_OTHERS = {
    b"CPHD": "phase history (CPHD)",
    b"CRSD": "raw radar data (CRSD)",
    b"II*\0": "a TIFF picture",
    b"MM\0*": "a TIFF picture",
    b"\x89HDF": "an HDF5 file",
}


def read_sicd_xml(path: Path, file: BinaryIO) -> lxml.etree._ElementTree:
    """The metadata of a SICD, after checks of the file's structure.

    Parameters
    ----------
    path : Path
        What an error names.
    file : file object
        The open file.

    Returns
    -------
    lxml.etree.ElementTree
        Plain XML without entities or references to other files, whose root is a SICD's.

    Raises
    ------
    SarsplatError
        If it is no NITF file, is truncated or states lengths that contradict its size, holds no SICD, or its XML is
        garbled or not plain.
    """
    import lxml.etree

    start, length = _first_extension(path, file)
    file.seek(start)
    text = file.read(length)
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
        for power in element.attrib.values():
            if not (power.isascii() and power.isdigit() and int(power[:9]) <= _HIGHEST_ORDER):
                raise SarsplatError(
                    f"{path} has a polynomial with the exponent {shown(power)}; at most {_HIGHEST_ORDER} is plausible, "
                    "so get it again"
                )
    return tree


def _first_extension(path: Path, file: BinaryIO) -> tuple[int, int]:
    """Where the data of the first data extension start, and how long they are, bytes."""
    size = file.seek(0, 2)
    file.seek(0)
    head = file.read(9)
    if head not in _MAGICS:
        kind = next((words for magic, words in _OTHERS.items() if head.startswith(magic)), None)
        raise SarsplatError(
            f"{path} is {kind or 'not a NITF file'}, so it is not a SICD; give files of complex SAR images (SICD)"
        )
    file.seek(_FILE_LENGTH_AT)
    numbers = _Numbers(path, file)
    stated, header = numbers.next(12), numbers.next(6)
    if stated != size:
        state = "is truncated" if size < stated else "is too long"
        raise SarsplatError(f"{path} {state}: {size} bytes where its header says {stated}; get it again")
    place, extension = header, None
    for kind, header_digits, data_digits in _PARTS:
        count = numbers.next(3)
        if count > _MOST_SEGMENTS or (kind is None and count):
            numbers.contradict()
        for _ in range(count if kind else 0):
            subheader, data = numbers.next(header_digits), numbers.next(data_digits)
            if kind == "data extension" and extension is None:
                extension = (place + subheader, data)
            place += subheader + data
    if place != size or numbers.place > header:
        numbers.contradict()
    if extension is None:
        raise SarsplatError(f"{path} is a NITF file without metadata in XML, so it is not a SICD; give SICD files")
    if extension[1] > _LONGEST_XML:
        raise SarsplatError(
            f"{path} has {extension[1]} bytes of metadata, where SICDs have at most {_LONGEST_XML}; get it again"
        )
    return extension


class _Numbers:
    """Decimal numbers of fixed width, one after the other, from a file's header."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file

    @property
    def place(self) -> int:
        """Bytes from the start of the file."""
        return self._file.tell()

    def next(self, digits: int) -> int:
        """The number in the next so many bytes."""
        text = self._file.read(digits)
        if len(text) != digits or not text.isdigit():
            self.contradict()
        return int(text)

    def contradict(self) -> NoReturn:
        """Give up on a header that cannot be right."""
        raise SarsplatError(f"{self._path} has a header whose lengths do not fit its size; get it again")
