"""Files of radars that are spoilt: metadata and pulses of SICDs and CPHDs, RSLCs, and MATLAB files of pulses."""

import io
import random
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import h5py
import numpy as np
import scipy.io

import cphds
import sicds
from fuzz_mutations import FLOATS, NUMBERS, Mutation, spoil_bytes
from made import NOISE, in_memory
from pulses import FREQUENCIES, circle, record
from rslcs import halves, write_rslc
from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Taylor
from sarsplat.importers import import_phase_history, import_rslc, import_sicd
from sarsplat.importers.history_cphd import describe_cphd
from sarsplat.importers.history_gotcha import read_gotcha
from sarsplat.importers.phase_apertures import apertures
from sarsplat.importers.phase_history import flights
from sarsplat.importers.phase_history_images import focus

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
        how = {"amplitude_table": kind == "RGAZIM", "calibration": (("BetaZero", 2.0),)}
        recording = sicds.Recording(rows=24, columns=20, kind=kind, pixel_type=pixel_type, **how)
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


def spoil_number(kinds: tuple[str, ...], kept: int) -> Mutation:
    """A number of one of these types, after a header of so many bytes."""

    def spoil(data: bytes, rng: random.Random) -> bytes:
        place = len(data) // 8 * 8 - 8 * rng.randrange(1, max(2, (len(data) - kept) // 8))
        with np.errstate(over="ignore"):
            packed = np.array(rng.choice((*FLOATS, 1e-300, 3e3, 1e10))).astype(rng.choice(kinds)).tobytes()
        return data[:place] + packed + data[place + len(packed) :]

    return spoil


def read_sicd(folder: Path) -> object:
    """A chip of a few metres."""
    return checked(import_sicd, [folder / "a.nitf"], folder / "set", size_m=5.0, around=sicds.SPOT)


def read_cphd(folder: Path) -> object:
    """What `info` says, and an image of a few metres."""
    told = "".join(describe_cphd(folder / "a.cphd").values()).encode()
    return told, checked(import_phase_history, [folder / "a.cphd"], folder / "set", size_m=2.6)


def checked(importer: Callable[..., Dataset], *places: object, **options: object) -> object:
    """All that is told about a dataset, whose pixels are finite."""
    with patch("os.fsync"):  # nothing of it is to be kept
        dataset = importer(*places, overwrite=True, **options)
    assert np.isfinite(dataset.power).all()
    assert dataset.signal is None or np.isfinite(dataset.signal).all()
    return str(dataset.source).encode(), dataset.fingerprint()


def rslc_seeds() -> list[bytes]:
    """Of three polarisations, and of one."""
    image = np.random.default_rng(0).normal(size=(40, 30, 2)) @ [1, 1j]
    images = {name: halves(image) for name in ("HH", "HV", "VV")}
    return [written(lambda path: write_rslc(path, images)), written(lambda path: write_rslc(path, {"HH": image}))]


def read_rslc(folder: Path) -> object:
    return checked(import_rslc, folder / "a.h5", folder / "set", size_m=60.0)


def mat_seeds() -> list[bytes]:
    """Records and cells, plain and compressed, and a bomb."""
    made = []
    record = {"fp": NOISE[0] * (1 + 2j), "freq": np.arange(6.0), "af": {"r": NOISE[0]}, "text": ["ab", "cd"], "no": {}}
    cells = np.array([1.0, "x", NOISE[0]], object)
    for compressed in (False, True):
        made.append(in_memory(scipy.io.savemat, {"data": record, "cells": cells}, do_compression=compressed))
    with h5py.File(buffer := io.BytesIO(), "w") as file:  # version 7.3, whose header is 512 bytes before it
        file["data/fp"], file["data/freq"], file["cells"] = NOISE[0], np.arange(6.0), np.array([[72]], "u2")
        file["signal"] = np.rec.fromarrays([NOISE[0], NOISE[0]], [("real", "f8"), ("imag", "f8")])
        file["cells"].attrs["MATLAB_class"] = np.bytes_("char")
    made.append(buffer.getvalue())
    return [*made, made[0][:128] + _packed_mat(made[0][128:] + bytes(1 << 22))]  # a bomb: 4 MiB in 5 KiB


def _packed_mat(data: bytes) -> bytes:
    inner = zlib.compress(data)
    return struct.pack("<II", 15, len(inner)) + inner


def spoil_mat(data: bytes, rng: random.Random) -> bytes:
    """A tag, a dimension or another number, at a place where one may be; perhaps compressed afterwards."""
    place = 128 + 4 * rng.randrange(max(1, (len(data) - 128) // 4))
    data = data[:place] + struct.pack("<I", rng.choice((*range(20), *NUMBERS)) % 2**32) + data[place + 4 :]
    return data[:128] + _packed_mat(data[128:]) if rng.random() < 0.3 else data


def pulse_seeds() -> list[bytes]:
    """Eight pulses of one flight past a point."""
    made = []
    data = record(circle(np.linspace(10, 11, 8)), [(1.0, 0.0, 0.0)], FREQUENCIES[::8])
    data |= {"af": {"r_correct": np.zeros(8), "ph_correct": np.ones(8)}}
    for kind in (np.float64, np.float32):
        single = {
            k: v.astype(kind) if isinstance(v, np.ndarray) and v.dtype.kind == "f" else v for k, v in data.items()
        }
        made.append(in_memory(scipy.io.savemat, {"data": single}))
    return made


def read_pulses(folder: Path) -> object:
    made = []
    for flight in flights([read_gotcha(folder / "a.mat")]):
        for aperture in apertures(flight, np.zeros(3), None):
            aperture.tilt_deg, aperture.resolution_m(Taylor())
            made.append(focus(aperture, ImageGrid(3, 3, (0.1, 0.1), (0.1, 0.1)), Taylor()))
    assert np.isfinite(made).all()
    return made
