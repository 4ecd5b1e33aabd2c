"""CPHDs that are spoilt: numbers, elements and attributes of their metadata, and numbers of their pulses."""

import random
import re
import tempfile
import warnings
from pathlib import Path

import numpy as np

import cphds
from fuzz_mutations import FLOATS, NUMBERS, spoil_bytes
from sarsplat.errors import SarsplatWarning
from sarsplat.importers import import_phase_history
from sarsplat.importers.history_cphd import describe_cphd

_XML_MOST = 40_000


def seeds() -> list[bytes]:
    """Small ones of both domains, versions and signs, and one of two channels."""
    antenna = cphds.arc(200.0, 4.0, 24)
    made = []
    for options in (
        {},
        {"domain": "TOA", "sign": 1, "version": "1.0.1"},
        {"form": "CI2", "channels": ("A", "B")},
    ):
        collection = cphds.Collection(antenna, samples=24, swath=4.0, **options)
        with tempfile.TemporaryDirectory() as folder:
            path = cphds.write_cphd(Path(folder) / "a.cphd", collection, [((0.0, 0.0, 0.0), 1.0)])
            made.append(path.read_bytes())
    return made


def spoil(data: bytes, rng: random.Random) -> bytes:
    """A number, an element or an attribute of the metadata, with lengths in the header that fit."""
    try:
        xml = cphds.xml_of(data)
        found = list(re.finditer(rb">([^<>]+)<", xml) if rng.random() < 0.7 else re.finditer(rb"<[^<>]*>", xml))
        if not found or len(xml) > _XML_MOST:
            return spoil_bytes(data, rng)
        here, group = rng.choice(found), int(found[0][0][:1] == b">")
        numbers = [str(value).encode() for value in (*NUMBERS, *FLOATS, -90, 180, 1e4)]
        words = [b"", b"FX", b"TOA", b"BISTATIC", b"CI4", b"<a/>", b"&lol;", b"\xff", b"x" * 9000, b"'", here[0] * 3]
        new = rng.choice(numbers if group and rng.random() < 0.8 else words)
        if rng.random() < 0.05:
            return cphds.with_xml(data, b'<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;&b;">]>' + xml)
        return cphds.with_xml(data, xml[: here.start(group)] + new + xml[here.end(group) :])
    except (ValueError, IndexError, KeyError):  # spoilt before
        return spoil_bytes(data, rng)


def spoil_pulse(data: bytes, rng: random.Random) -> bytes:
    """A number of the pulses or of the signal."""
    place = len(data) // 8 * 8 - 8 * rng.randrange(1, max(2, len(data) // 8 - 512))
    with np.errstate(over="ignore"):
        packed = np.array(rng.choice((*FLOATS, 1e-300, 3e3, 1e10))).astype(rng.choice((">f4", ">f8"))).tobytes()
    return data[:place] + packed + data[place + len(packed) :]


def read(folder: Path) -> object:
    """What `info` says, and an image of a few metres."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SarsplatWarning)  # there is but one view
        told = "".join(describe_cphd(folder / "a.cphd").values())
        dataset = import_phase_history([folder / "a.cphd"], folder / "set", size_m=2.6, overwrite=True, channel=None)
    assert dataset.signal is not None and np.isfinite(dataset.signal).all()
    return told.encode(), str(dataset.source).encode(), dataset.power.mean()
