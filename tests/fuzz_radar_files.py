"""SICDs and CPHDs that are spoilt: numbers, elements and attributes of their metadata, and numbers of their pulses."""

import random
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

import cphds
import sicds
from fuzz_mutations import FLOATS, NUMBERS, Mutation, spoil_bytes
from sarsplat.data import Dataset
from sarsplat.importers import import_phase_history, import_sicd
from sarsplat.importers.history_cphd import describe_cphd

_XML_MOST = 40_000
_NUMBERS = [str(value).encode() for value in (*NUMBERS, *FLOATS, -90, 180, 1e4)]
_WORDS = [b"", b"L", b"R", b"PLANE", b"RGZERO", b"RMA", b"FX", b"TOA", b"BISTATIC", b"CI4", b"<a/>", b"&lol;", b"\xff"]
_WORDS += [b"x" * 70_000, b"'"]
_BOMBS = [b'<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;&b;">]>', b'<!DOCTYPE a SYSTEM "file:///etc/passwd">']


def written(write: Callable[[Path], object]) -> bytes:
    """What a function writes to a file."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "file")
        return (Path(folder) / "file").read_bytes()


def sicd_seeds() -> list[bytes]:
    """One of each pixel type, small, and one of the oldest version."""
    made = []
    for kind, pixel_type in (("PLANE", "RE16I_IM16I"), ("RGAZIM", "AMP8I_PHS8I"), ("RGZERO", "RE32F_IM32F")):
        options = {"kind": kind, "pixel_type": pixel_type, "amplitude_table": kind == "RGAZIM", "beta_zero": 2.0}
        recording = sicds.Recording(rows=24, columns=20, **options)
        made.append(written(lambda path, one=recording: sicds.write_sicd(path, sicds.Track(), [(0, 0, 0)], one)))
    return [*made, sicds.of_version(made[-1], "0.4.0")]


def cphd_seeds() -> list[bytes]:
    """Small ones of both domains, versions and signs, and one of two channels."""
    made = []
    for options in ({}, {"domain": "TOA", "sign": 1, "version": "1.0.1"}, {"form": "CI2", "channels": ("A", "B")}):
        collection = cphds.Collection(cphds.arc(200.0, 4.0, 24), samples=24, swath=4.0, **options)
        made.append(written(lambda path, one=collection: cphds.write_cphd(path, one, [((0.0, 0.0, 0.0), 1.0)])))
    return made


def spoil_xml(files: ModuleType) -> Mutation:
    """A number, an element or an attribute of the metadata, with lengths in the header that fit."""

    def spoil(data: bytes, rng: random.Random) -> bytes:
        try:
            xml = files.xml_of(data)[:_XML_MOST]
            if rng.random() < 0.05:
                return files.with_xml(data, rng.choice(_BOMBS) + xml)
            found = list(re.finditer(rb">([^<>]+)<", xml) if rng.random() < 0.7 else re.finditer(rb"<[^<>]*>", xml))
            here, group = rng.choice(found), int(found[0][0][:1] == b">")
            new = rng.choice(_NUMBERS if group and rng.random() < 0.8 else [*_WORDS, here[0] * 3])
            return files.with_xml(data, xml[: here.start(group)] + new + xml[here.end(group) :])
        except (ValueError, IndexError, KeyError):  # spoilt before
            return spoil_bytes(data, rng)

    return spoil


def spoil_pulse(data: bytes, rng: random.Random) -> bytes:
    """A number of the pulses or of the signal."""
    place = len(data) // 8 * 8 - 8 * rng.randrange(1, max(2, len(data) // 8 - 512))
    with np.errstate(over="ignore"):
        packed = np.array(rng.choice((*FLOATS, 1e-300, 3e3, 1e10))).astype(rng.choice((">f4", ">f8"))).tobytes()
    return data[:place] + packed + data[place + len(packed) :]


def read_sicd(folder: Path) -> object:
    """A chip of a few metres."""
    return _checked(import_sicd, [folder / "a.nitf"], folder / "set", size_m=5.0, around=sicds.SPOT, overwrite=True)


def read_cphd(folder: Path) -> object:
    """What `info` says, and an image of a few metres."""
    told = "".join(describe_cphd(folder / "a.cphd").values()).encode()
    options = {"size_m": 2.6, "overwrite": True, "channel": None}
    return told, _checked(import_phase_history, [folder / "a.cphd"], folder / "set", **options)


def _checked(importer: Callable[..., Dataset], *arguments: object, **options: object) -> object:
    """All that is told about it."""
    dataset = importer(*arguments, **options)
    assert dataset.signal is not None and np.isfinite(dataset.signal).all()
    return str(dataset.source).encode(), dataset.power.mean()
