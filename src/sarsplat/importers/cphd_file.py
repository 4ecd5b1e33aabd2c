"""One CPHD file (compensated phase history): its metadata, checked, and the parameters of its pulses.

sarkit reads the format, but files are untrusted: the lengths in a header must fit the file, and the XML must be plain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from jaxtyping import Int64

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.extras import needed
from sarsplat.geometry import Place
from sarsplat.importers.files import printable, raise_damaged, whole_in
from sarsplat.importers.sarkit_xml import LONGEST_XML, Metadata, any_version, plain_xml, sarkit_errors

if TYPE_CHECKING:
    import lxml.etree

MAGIC = b"CPHD/"
_SAMPLE_BYTES = {"CI2": 2, "CI4": 4, "CF8": 8}  # formats of samples in the standard → bytes of one
_MOST_BYTES_OF_A_PULSE = 1 << 16
_LARGEST = 1e12  # maximum of all numbers
_VECTORS = {
    "TxTime": 0, "TxPos": 3, "RcvTime": 0, "RcvPos": 3, "SRPPos": 3, "FX1": 0, "FX2": 0, "TOA1": 0, "TOA2": 0, "SC0": 0,
    "SCSS": 0,
}  # fmt: skip
"""Parameters of pulses in every file → numbers of each (0: a scalar)."""


@dataclass(frozen=True)
class Channel:
    """Metadata of one channel."""

    name: str
    pulses: int
    samples: int
    """Number of samples of a pulse."""
    polarisation: str
    """Transmitted and received, such as "V:V"; "" if not stated."""

    def __str__(self) -> str:
        return shown(self.name) + (f" ({self.polarisation})" if self.polarisation else "")


@dataclass(frozen=True)
class Cphd(Metadata):
    """Metadata of one file, consistent with its size."""

    version: str
    channels: list[Channel]
    domain: str
    """Domain of the samples: "FX", frequencies, or "TOA", times of arrival."""
    sign: int
    """Sign of the phase of more distant scatterers, 1 or −1."""

    def load(self, name: str) -> Any:
        """Return the value of an element; None if it is missing."""
        from sarkit.cphd import XmlHelper

        with sarkit_errors(self.path, "CPHD"):
            return XmlHelper(self.tree).load(any_version(name))

    @property
    def place(self) -> Place:
        """Reference point of the scene."""
        place = self.load("SceneCoordinates/IARP/ECF")
        if place is None or not np.all(np.abs(place) <= _LARGEST):
            raise_damaged(self.path, "has no valid reference point (SceneCoordinates/IARP)")
        try:
            return Place.of_ecef(np.asarray(place, np.float64))
        except SarsplatError as error:
            raise SarsplatError(f"{self.path}: the reference point of the scene: {error}") from error

    def channel(self, name: str | None) -> Channel:
        """Return the channel of this name, or the only one."""
        found = [channel for channel in self.channels if name in (None, channel.name)]
        if len(found) != 1:
            what = "several channels" if name is None else f"no channel {shown(name)}"
            raise SarsplatError(f"{self.path} has {what}; choose `channel` among {self.listed}")
        return found[0]

    @property
    def listed(self) -> str:
        """Channels in words."""
        return ", ".join(map(str, self.channels[:20]))

    def pulses(self, channel: Channel) -> dict[str, np.ndarray]:
        """Read the parameters of a channel's pulses with a signal; "index" numbers them in the file.

        Raises if a needed one is missing or not finite.
        """
        import sarkit.cphd

        with open_file(self.path) as file, sarkit_errors(self.path, "CPHD"):
            stored = sarkit.cphd.Reader(file).read_pvps(channel.name)
            names = stored.dtype.names or ()
            if missing := [name for name in _VECTORS if name not in names]:
                raise_damaged(self.path, f"lacks {', '.join(missing)} of its pulses")
            index: Int64[np.ndarray, " pulses"] = np.arange(len(stored))
            if "SIGNAL" in names:
                index = np.flatnonzero(stored["SIGNAL"] == 1)
            if len(index) < 2:
                raise_damaged(self.path, f"has {counted(len(index), 'pulse')} with a signal in channel {channel}")
            values = {name: np.asarray(stored[name], np.float64)[index] for name in _VECTORS}
            values["AmpSF"] = np.asarray(stored["AmpSF"] if "AmpSF" in names else np.ones(len(stored)), float)[index]
        for name, numbers in values.items():
            numbers_each = _VECTORS.get(name, 0)
            wrong = ~(np.abs(numbers) <= _LARGEST)  # also catches NaN
            if numbers.shape[1:] != ((numbers_each,) if numbers_each else ()) or wrong.any():
                first = f", such as {numbers[wrong][0]:g}" if wrong.any() else ""
                raise_damaged(self.path, f"has pulses whose {name} is impossible{first}")
        return {**values, "index": index}


def open_cphd(path: Path) -> Cphd:
    """Read the metadata of one file, without its pulses.

    Raises if it is no monostatic CPHD of a supported version, truncated, garbled, or compressed.
    """
    with needed("phase-history", "a CPHD"):
        from sarkit.cphd import VERSION_INFO
    with open_file(path) as file:
        tree, blocks = _tree(path, file)
    name = str(tree.getroot().tag)
    namespace, _, kind = name.removeprefix("{").partition("}")
    if kind != "CPHD":
        raise_damaged(path, f"holds {shown(name)}, not the metadata of a CPHD")
    if namespace not in VERSION_INFO:
        known = " and ".join(str(one["version"]) for one in VERSION_INFO.values())
        raise SarsplatError(f"{path} is CPHD of {shown(namespace)}; {known} are read, so get it in one of these")
    with sarkit_errors(path, "CPHD"):
        made = Cphd(path, tree, str(VERSION_INFO[namespace]["version"]), _channels(path, tree, blocks), "", 0)
        domain, sign = made.text("Global/DomainType"), made.load("Global/SGN")
        if made.text("CollectionID/CollectType") != "MONOSTATIC":
            raise SarsplatError(
                f"{path} is {shown(made.text('CollectionID/CollectType').lower())}; give a collection whose radar "
                "transmits and receives itself (monostatic)"
            )
        if domain not in ("FX", "TOA") or sign not in (1, -1):
            raise_damaged(path, f"has the domain {shown(domain)} and sign {shown(sign)}, not FX or TOA and ±1")
        return replace(made, domain=domain, sign=sign)


def _tree(path: Path, file: BinaryIO) -> tuple[lxml.etree._ElementTree, dict[str, int]]:
    """Read the metadata, and the lengths of the blocks, which must lie in the file."""
    from sarkit.cphd import read_file_header

    size, sections = path.stat().st_size, {}
    if file.read(len(MAGIC)) != MAGIC:
        raise SarsplatError(f"{path} is not a CPHD file; give one")
    file.seek(0)
    with sarkit_errors(path, "CPHD"):
        first, values = read_file_header(file)
    version = first.removeprefix(MAGIC.decode()).strip()
    if version.startswith("0."):
        raise SarsplatError(f"{path} is CPHD of version {shown(version)}, which is not read; get it as 1.0.1 or 1.1.0")
    for block in ("XML", "PVP", "SIGNAL"):
        place, length = values.get(f"{block}_BLOCK_BYTE_OFFSET", ""), values.get(f"{block}_BLOCK_SIZE", "")
        if not all(text.isascii() and text.isdigit() and len(text) < 19 for text in (place, length)):
            raise_damaged(path, f"has a header that does not say where its {block} block is")
        if int(place) + int(length) > size:
            raise_damaged(path, f"is truncated: {size} bytes, but its {block} block ends at {int(place) + int(length)}")
        sections[block] = int(length)
    if sections["XML"] > LONGEST_XML:
        raise_damaged(path, f"has {sections['XML']} bytes of metadata, more than {LONGEST_XML}")
    file.seek(int(values["XML_BLOCK_BYTE_OFFSET"]))
    return plain_xml(path, file.read(sections["XML"]), "CPHD"), sections


def _channels(path: Path, tree: lxml.etree._ElementTree, blocks: dict[str, int]) -> list[Channel]:
    """Read the channels of the metadata, whose arrays must lie in the blocks."""
    data = tree.find("{*}Data")
    listed = [] if data is None else data.findall("{*}Channel")
    if data is None or not listed:
        raise_damaged(path, "has no channels in its metadata")
    if data.find("{*}SignalCompressionID") is not None or data.find("{*}Channel/{*}CompressedSignalSize") is not None:
        raise SarsplatError(
            f"{path} has compressed signals ({shown(data.findtext('{*}SignalCompressionID'))}), which only its maker "
            "can unpack; get it uncompressed"
        )
    form = data.findtext("{*}SignalArrayFormat")
    if form not in _SAMPLE_BYTES:
        raise SarsplatError(f"{path} has samples of the format {shown(form)}; {', '.join(_SAMPLE_BYTES)} are read")
    each = _whole(path, data, "NumBytesPVP", 1, _MOST_BYTES_OF_A_PULSE)
    found = []
    for one in listed:
        name = (one.findtext("{*}Identifier") or "").strip()
        pulses, samples = _whole(path, one, "NumVectors"), _whole(path, one, "NumSamples")
        ends = {
            "PVP": _whole(path, one, "PVPArrayByteOffset") + pulses * each,
            "SIGNAL": _whole(path, one, "SignalArrayByteOffset") + pulses * samples * _SAMPLE_BYTES[form],
        }
        for block, end in ends.items():
            if end > blocks[block]:
                what = f"{pulses} pulses of {samples} samples in {shown(name)}"
                raise_damaged(path, f"has {what}, more than its {block} block holds")
        if not name.isprintable() or "'" in name or len(name) > 200 or name != one.findtext("{*}Identifier"):
            raise_damaged(path, f"has a channel called {shown(name)}, which is no name")
        found.append(Channel(name, pulses, samples, _polarisation(tree, name)))
    return found


def _whole(path: Path, element: lxml.etree._Element, name: str, least: int = 0, most: int = 10**15) -> int:
    return whole_in(path, (element.findtext("{*}" + name) or "").strip(), name, least, most)


def _polarisation(tree: lxml.etree._ElementTree, channel: str) -> str:
    for one in tree.iterfind("{*}Channel/{*}Parameters"):
        if one.findtext("{*}Identifier") == channel:
            pair = [printable(one.findtext(any_version(f"Polarization/{way}"))) for way in ("TxPol", "RcvPol")]
            return ":".join(pair) if all(pair) else ""
    return ""
