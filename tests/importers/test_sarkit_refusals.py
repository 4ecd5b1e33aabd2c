"""CPHDs and SICDs of other kinds, contradictory or hostile: one sentence each, in little time and memory."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("sarkit")

import cphds
import sicds
from cphds import Collection, arc, write_cphd
from fuzz import sentence_faults, watched
from pulses import circle, record, write
from sarsplat.cli import main
from sarsplat.errors import SarsplatError
from sarsplat.importers import import_phase_history, import_sicd
from sicds import SPOT, Recording, Track, write_sicd

BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in itertools.pairwise("abcdefghij")
)
"""XML whose entities grow tenfold nine times."""
ARC = arc(200.0, 4.0, 40)
POINTS = [((0.0, 0.0, 0.0), 1.0)]
Spoil = Callable[[bytes], bytes]


def spoilt(path: Path, spoil: Spoil | dict) -> Path:
    """A CPHD or a SICD, spoilt, or of another collection."""
    if path.suffix == ".nitf":
        write_sicd(path, Track(), [(0, 0, 0)], Recording(rows=64, columns=60))
    else:
        options = spoil if isinstance(spoil, dict) else {}
        points = options.pop("points", POINTS)
        with np.errstate(all="ignore"):
            write_cphd(path, Collection(**{"antenna": ARC, "samples": 32, "swath": 8.0, **options}), points)
    if not isinstance(spoil, dict):
        path.write_bytes(spoil(path.read_bytes()))
    return path


def changes(of: ModuleType) -> Callable[[str, str], Spoil]:
    """Make changes of a file's metadata: every match of a pattern."""

    def change(old: str, new: str, data: bytes) -> bytes:
        text, times = re.subn(old, new, of.xml_of(data).decode(), flags=re.DOTALL)
        assert times
        return of.with_xml(data, text.encode())

    return lambda old, new: partial(change, old, new)


changed = changes(cphds)
CPHD: list[tuple[Spoil | dict, str]] = [
    (lambda data: data[:-100], "is truncated: .* its SIGNAL block ends at"),
    (lambda data: b"CPHD/0.3" + data[10:], "version '0.3.*get it as 1.0.1 or 1.1.0"),
    (lambda data: b"CRSD/1.0\n" + data, "is raw radar data .CRSD.*; get it as CPHD or SICD"),
    (lambda data: b"NITF02.10" + data, "a NITF file, not phase history; import it with `.*sarsplat import sicd`"),
    (changed("^", BOMB + "]>"), "DOCTYPE|no XML"),
    (changed("^", '<!DOCTYPE a SYSTEM "file:///etc/passwd">'), "DOCTYPE"),
    (changed('exponent1="1"', 'exponent1="400000000"'), "exponent '400000000'"),
    (changed("cphd/1.1.0", "cphd/1.2.0"), "is CPHD of 'http.*1.2.0'; 1.0.1 and 1.1.0 are read"),
    (changed("MONOSTATIC", "BISTATIC"), "is 'bistatic'; give a collection whose radar transmits and receives"),
    (changed("<NumBytesP", "<SignalCompressionID>zip</SignalCompressionID><NumBytesP"), "compressed signals .'zip'"),
    (changed("CF8", "CF16"), "samples of the format 'CF16'; CI2, CI4"),
    (changed("<NumSamples>32", "<NumSamples>33"), "more than its SIGNAL block holds"),
    (changed("<SRPPos>.*</SRPPos>", ""), "lacks SRPPos of its pulses"),
    (changed("<DomainType>FX", "<DomainType>XF"), "the domain 'XF'"),
    (changed("<SGN>-1", "<SGN>2"), "sign 2"),
    (changed("<ECF><X>[^<]*", "<ECF><X>nan"), "no valid reference point"),
    (changed("<ECF><X>[^<]*", "<ECF><X>9e9"), "the reference point of the scene: height_m"),
    (changed("<ImageArea>.*</ImageArea>", ""), "no valid ImageArea"),
    (changed("<CODId>c", "<CODId>e"), "no dwell times .CODTime."),
    ({"moved": np.tile([100.0, 0, 0], (40, 1))}, r"sent and received 1\.\d° apart .*bistatic"),
    ({"scaled": np.where(np.arange(40) == 7, np.nan, 1.0)}, "pulses whose AmpSF is impossible, such as nan"),
    ({"points": [((0.0, 0.0, 0.0), 1e12)]}, "holds a sample of .*, not finite or above"),
    ({"signal": np.zeros(40)}, "0 pulses with a signal"),
    *(({"domain": domain, "shift": np.linspace(0, 20, 40)}, "all have only .* in common") for domain in ("FX", "TOA")),
    ({"antenna": ARC[[*range(20), *range(18, 38)]]}, "turns back after pulse"),
    ({"stretch": -1.0}, "must be positive"),
]  # fmt: skip


def with_pixel(value: float) -> Spoil:
    """Another real part of the pixel in the middle of 64 × 60."""

    def change(data: bytes) -> bytes:
        place = int(data[354:360]) + int(data[363:369]) + 8 * (32 * 60 + 30)  # header, header of the image, pixels
        return data[:place] + np.array(value, ">f4").tobytes() + data[place + 4 :]

    return change


changed = changes(sicds)
SICD: list[tuple[Spoil | dict, str]] = [
    (lambda data: data[:-100], "is truncated or too long"),
    (lambda data: b"CPHD/1.0.1\n" + data, "is not a NITF file"),
    (lambda data: data.replace(b"NC2" + data[data.index(b"NC2") + 3 :][:5], b"NC099999"), "is not a valid SICD"),
    (changed("<SICD .*", '<SIDD xmlns="urn:SIDD:3.0.0"/>'), "holds no metadata of a SICD"),
    (changed("^", BOMB + "]>"), "DOCTYPE|no XML"),
    (changed("<NumRows>64</NumRows>", "<NumRows>65</NumRows>"), "segments of other sizes"),
    (changed("RE32F_IM32F", "RE16I_IM16I"), "segments of other sizes"),
    (changed("RE32F_IM32F", "RE64F_IM64F"), "pixels of type 'RE64F_IM64F'"),
    (changed("<NumRows>64", "<NumRows>6400000000"), "as NumRows, not a number from 1 to"),
    (changed("MONOSTATIC", "BISTATIC"), "bistatic"),
    (changed("<SideOfTrack>R", "<SideOfTrack>L"), "SideOfTrack 'L'"),
    (changed("<SS>[^<]*</SS>", "<SS>nan</SS>"), "nan"),
    (changed("<ImpRespWid>[^<]*</ImpRespWid>", "<ImpRespWid>-1</ImpRespWid>"), "ImpRespWid"),
    (changed("<ARPPoly>.*</ARPPoly>", ""), "ARP_Poly"),
    (changed("<UVectECF>.*?</UVectECF>", "<UVectECF><X>1</X><Y>0</Y><Z>0</Z></UVectECF>"), "span no plane"),
    *(
        (changed("SICD:1.4.0", f"SICD:{version}"), rf"is SICD of version {version}, and 0\.4\.0, .*, 1\.5 are read")
        for version in ("0.3.1", "1.9.0", "x")
    ),
    (with_pixel(math.nan), "holds nan"),
    (with_pixel(1e30), "holds 1e"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "spoil", "told"), [*(("a.cphd", *one) for one in CPHD), *(("a.nitf", *one) for one in SICD)]
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, capfd, name, spoil, told):
    path = spoilt(tmp_path / name, spoil)
    words = ["phase-history", str(path), "--size", "6"]
    if name == "a.nitf":
        words = ["sicd", str(path), f"--around={SPOT[0]},{SPOT[1]},{SPOT[2]}", "--size", "8"]
    with watched() as cost:
        assert main(["import", *words, "--out", str(tmp_path / "set")]) == 2
    [line] = capfd.readouterr().err.splitlines()
    assert re.search(told, line), line
    assert sentence_faults(line) == []
    assert not (tmp_path / "set").exists()
    assert cost.seconds < 1 and cost.bytes < 64 << 20


def test_worlds_are_not_mixed(tmp_path):
    placed = spoilt(tmp_path / "a.cphd", {})
    other = write(tmp_path / "b.mat", record(circle(np.linspace(-1, 1, 20)), [(0, 0, 0)]))
    for files, options, told in (
        ([placed, other], {}, "b.mat has no place on earth; import files"),
        ([placed], {"place": (95.0, 8.0)}, "latitude_deg 95.0 of a place on earth"),
        ([placed], {"place": (47.0,)}, "must be a latitude, a longitude and, if need be, a height"),
    ):
        with pytest.raises(SarsplatError, match=told):
            import_phase_history(files, tmp_path / "out", size_m=4.0, **options)


MIDDLE = r"the middle of image\.nitf is `pixel=\(150, 140\)`, or `around=\(47\.300000, 8\.500000, 420\.0\)`"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"around": (47.3,)}, "must be a latitude, a longitude"),
        ({"size_m": -3.0}, "must be positive"),
        ({"size_m": 1e-9}, "give a size that makes 8 to 4096 a side"),
        ({"size_m": 500.0}, f"160 m × 160 m.*give a smaller `size_m`: {MIDDLE}"),
        ({"around": (48.0, 8.5)}, f"another spot: {MIDDLE}"),
        ({"around": (-47.3, -171.0)}, f"does not show the spot .*; {MIDDLE}"),
        ({"pixel": (400.0, 10.0)}, r"is outside .* 300 rows and 280 columns, .*`pixel=\(150, 140\)`"),
        ({"heading_deg": math.nan}, "x_towards_deg nan"),
    ],
)
def test_requests_that_a_sicd_cannot_meet(tmp_path, options, told):
    path = write_sicd(tmp_path / "image.nitf", Track(), [(0.0, 0.0, 0.0), (8.0, -5.0, 0.0)], Recording())
    with pytest.raises(SarsplatError, match=told):
        import_sicd([path], tmp_path / "set", **{"size_m": 48.0, **options})
    assert not (tmp_path / "set").exists()


def test_the_same_file_twice(tmp_path):
    path = spoilt(tmp_path / "a.nitf", {})
    (tmp_path / "other.nitf").symlink_to(path)
    with pytest.raises(SarsplatError, match=r"given twice, also as .*a\.nitf"):
        import_sicd([path, tmp_path / "other.nitf"], tmp_path / "set", size_m=48.0)
