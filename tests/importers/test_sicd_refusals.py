"""SICDs that are spoilt, and requests that they cannot meet: one sentence, and nothing is written."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

pytest.importorskip("sarkit")

from refusals import BOMB, check_spoilt, xml_changes
from sarsplat.cli import main
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.importers import import_sicd
from sicds import SPOT, Recording, Track, with_xml, write_sicd, xml_of

PLACES = [(0.0, 0.0, 0.0), (8.0, -5.0, 0.0)]  # m east, north and above the spot
MIDDLE = r"the middle of image\.nitf is --pixel 150,140, or --around=47\.300000,8\.500000,420\.0"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--size", "48m", "--around", "47.3"], "write it as 47.3769,8.5417"),
        (["--size", "large"], "is not a valid length"),
        (["--size", "-3"], "must be positive"),
        (["--size", "1e-9"], "give a size that makes 8 to 4096 a side"),
        (["--size", "500m"], "160 m × 160 m.*give a smaller --size: the middle of image.nitf is --pixel 150,140"),
        (["--size", "48m", "--around", "48,8.5"], f"another spot: {MIDDLE}"),
        (["--size", "48m", "--around=-47.3,-171"], f"does not show the spot .*; {MIDDLE}"),
        (["--size", "48m", "--pixel", "400,10"], f"is outside .* 300 rows and 280 columns, .*; {MIDDLE}"),
        (["--size", "48m", "--pixel", "1,1", "--around", "47.3,8.5"], "give one of them"),
        (["--size", "48m", "--around", "147.3,8.5"], "is not a latitude"),
    ],
)  # fmt: skip
def test_requests_that_cannot_be_met(tmp_path, capsys, options, told):
    path = write_sicd(tmp_path / "image.nitf", Track(), PLACES, Recording())
    assert main(["import", "sicd", str(path), *options, "--out", str(tmp_path / "set")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert re.search(told, line), line
    assert not (tmp_path / "set").exists()


def test_the_same_file_twice(tmp_path):
    path = write_sicd(tmp_path / "image.nitf", Track(), PLACES, Recording())
    (tmp_path / "other.nitf").symlink_to(path)
    for same, told in ((path, "given twice;"), (tmp_path / "other.nitf", "given twice, also as .*image.nitf")):
        with pytest.raises(SarsplatError, match=told):
            import_sicd([path, same], tmp_path / "set", size_m=48.0)


@pytest.mark.filterwarnings("ignore:the (2 )?training views")
def test_other_polarisations_are_said(tmp_path):
    paths = [write_sicd(tmp_path / f"{k}.nitf", Track(bearing=90 * k), PLACES, Recording()) for k in range(2)]
    paths[1].write_bytes(changed("V:V", "H:V")(paths[1].read_bytes()))
    with pytest.warns(SarsplatWarning, match="polarisations differ") as told:
        made = import_sicd(paths, tmp_path / "set", size_m=20.0)
    assert sum("polarisations" in str(one.message) for one in told) == 1
    assert any("polarisations differ (H:V, V:V), but are taken" in text for text in made.source["assumptions"])


changed = xml_changes(xml_of, with_xml)


def with_pixel(data: bytes, value: float) -> bytes:
    """Another real part of the pixel in the middle of 64 × 60."""
    place = int(data[354:360]) + int(data[363:369]) + 8 * (32 * 60 + 30)  # header, header of the image, pixels
    return data[:place] + np.array(value, ">f4").tobytes() + data[place + 4 :]


SIDD = changed("<SICD .*", '<SIDD xmlns="urn:SIDD:3.0.0"/>')


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda data: data[:-100], "is truncated or too long"),
        (lambda data: data + b"more", "is truncated or too long"),
        (lambda data: data[:300], "is truncated or too long"),
        (lambda data: b"", "is not a NITF file"),
        (lambda data: b"CPHD/1.0.1\n" + data, "is not a NITF file"),
        (lambda data: data[:360] + b"009" + data[363:], "is not a valid SICD"),
        (changed("</Grid>", "</Gird>"), "metadata that are not valid XML"),
        (changed("^.*$", ""), "holds no metadata of a SICD"),
        (changed("^", BOMB + "]>"), "DOCTYPE|no XML"),
        (changed("^", '<!DOCTYPE a SYSTEM "file:///etc/passwd">'), "DOCTYPE"),
        (changed("<SICD .*", "<a/>"), "holds no metadata of a SICD"),
        (SIDD, "holds no metadata of a SICD"),
        (changed('exponent1="1"', 'exponent1="400000000"'), "exponent '400000000'"),
        (changed("<NumRows>64</NumRows>", "<NumRows>65</NumRows>"), "segments of other sizes"),
        (changed("<NumCols>60</NumCols>", "<NumCols>61</NumCols>"), "segments of other sizes"),
        (changed("RE32F_IM32F", "RE16I_IM16I"), "segments of other sizes"),
        (changed("RE32F_IM32F", "RE64F_IM64F"), "pixels of type 'RE64F_IM64F'"),
        (changed("<NumRows>64", "<NumRows>6400000000"), "must be 1 to"),
        (changed("MONOSTATIC", "BISTATIC"), "bistatic"),
        (changed("<SideOfTrack>R", "<SideOfTrack>L"), "SideOfTrack 'L'"),
        (changed("<SS>[^<]*</SS>", "<SS>nan</SS>"), "nan"),
        (changed("<SS>[^<]*</SS>", ""), "Row_SS"),
        (changed("<ImpRespWid>[^<]*</ImpRespWid>", "<ImpRespWid>-1</ImpRespWid>"), "ImpRespWid"),
        (changed("<ARPPoly>.*</ARPPoly>", ""), "ARP_Poly"),
        (changed("<UVectECF>.*?</UVectECF>", "<UVectECF><X>1</X><Y>0</Y><Z>0</Z></UVectECF>"), "span no plane"),
        (changed("<Type>PLANE", "<Type>SPIRAL"), "not a valid SICD"),
        (lambda data: with_pixel(data, math.nan), "holds nan"),
        (lambda data: with_pixel(data, 1e30), "holds 1e"),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, capfd, spoil, told):
    path = write_sicd(tmp_path / "image.nitf", Track(), [(0, 0, 0)], Recording(rows=64, columns=60))
    path.write_bytes(spoil(path.read_bytes()))
    words = ["sicd", str(path), f"--around={SPOT[0]},{SPOT[1]},{SPOT[2]}", "--size", "8"]
    check_spoilt(words, tmp_path / "set", told, capfd)
