"""SICDs that are spoilt: numbers, elements and attributes of their metadata."""

import random
import re
import tempfile
import warnings
from pathlib import Path

import numpy as np

import sicds
from fuzz_mutations import FLOATS, NUMBERS, spoil_bytes
from sarsplat.errors import SarsplatWarning
from sarsplat.importers import import_sicd


def seeds() -> list[bytes]:
    """One of each pixel type, small, and one of the oldest version."""
    made = []
    for kind, pixel_type in (("PLANE", "RE16I_IM16I"), ("RGAZIM", "AMP8I_PHS8I"), ("RGZERO", "RE32F_IM32F")):
        recording = sicds.Recording(
            rows=24, columns=20, kind=kind, pixel_type=pixel_type, amplitude_table=kind == "RGAZIM", beta_zero=2.0
        )
        with tempfile.TemporaryDirectory() as folder:
            path = sicds.write_sicd(Path(folder) / "a.nitf", sicds.Track(), [(0, 0, 0)], recording)
            made.append(path.read_bytes())
    return [*made, sicds.of_version(made[-1], "0.4.0")]


def spoil(data: bytes, rng: random.Random) -> bytes:
    """A number, an element or an attribute of the metadata, with lengths in the header that fit."""
    try:
        xml = sicds.xml_of(data)
    except ValueError:  # spoilt before
        return spoil_bytes(data, rng)
    found = list(re.finditer(rb">([^<>]+)<", xml) if rng.random() < 0.7 else re.finditer(rb"<[^<>]*>", xml))
    if not found:
        return spoil_bytes(data, rng)
    here, group = rng.choice(found), int(found[0][0][:1] == b">")
    numbers = [str(value).encode() for value in (*NUMBERS, *FLOATS, -90, 180, 1e4)]
    words = [b"", b"L", b"R", b"PLANE", b"RGZERO", b"RMA", b"<a/>", b"&lol;", b"\xff", b"x" * 70_000, here[0] * 3]
    bombs = [b'<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;&b;">]>', b'<!DOCTYPE a SYSTEM "file:///etc/passwd">']
    if rng.random() < 0.05:
        return sicds.with_xml(data, rng.choice(bombs) + xml)
    new = rng.choice(numbers if group and rng.random() < 0.8 else words)
    return sicds.with_xml(data, xml[: here.start(group)] + new + xml[here.end(group) :])


def read(folder: Path) -> object:
    """A chip of a few metres, and all that is told about it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SarsplatWarning)  # there is but one view
        dataset = import_sicd([folder / "a.nitf"], folder / "set", size_m=5.0, around=sicds.SPOT, overwrite=True)
    assert dataset.signal is not None and np.isfinite(dataset.signal).all()
    return str(dataset.source).encode(), dataset.power.mean()
