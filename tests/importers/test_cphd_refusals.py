"""CPHD files that are damaged, hostile or of another kind: one sentence each, in little time and memory."""

import re

import numpy as np
import pytest

pytest.importorskip("sarkit")

from cphds import PLACE, Collection, arc, with_xml, write_cphd, xml_of
from pulses import circle, record, write
from refusals import BOMB, check_spoilt, xml_changes
from sarsplat.cli import main

ARC = arc(200.0, 4.0, 40)
MADE = Collection(ARC, samples=32, swath=8.0)
POINTS = [((0.0, 0.0, 0.0), 1.0)]


changed = xml_changes(xml_of, with_xml)


def stated(name: bytes, value: bytes):
    """Another number in the header, which stays as long."""

    def change(data: bytes) -> bytes:
        place = data.index(name) + len(name) + 4
        end = data.index(b"\n", place)
        return data[:place] + value.rjust(end - place, b"0")[: end - place] + data[end:]

    return change


def recorded(points=POINTS, **options):
    """Another collection."""

    def change(_data: bytes, path) -> bytes:
        made = Collection(**{"antenna": ARC, "samples": 32, "swath": 8.0, **options})
        return write_cphd(path, made, points).read_bytes()

    return change


SPOILT = [
    (lambda data: data[:-100], "is truncated: .* its SIGNAL block ends at"),
    (lambda data: data[:3000], "is truncated"),
    (lambda data: data[:40], "does not say where its XML block is"),
    (lambda data: b"CPHD/0.3" + data[10:], "version '0.3.*get it as 1.0.1 or 1.1.0"),
    (lambda data: b"CRSD/1.0\n" + data, "is raw radar data .CRSD.*; get it as CPHD or SICD"),
    (lambda data: b"NITF02.10" + data, "a NITF file, not phase history; import it with `sarsplat import sicd`"),
    (lambda data: xml_of(data), "is the metadata of a CPHD .XML., without its pulses"),
    (lambda data: b'<?xml version="1.0"?>' + xml_of(data), "is XML, perhaps the metadata of phase history"),
    (lambda data: b"", "is not a CPHD file"),
    (stated(b"XML_BLOCK_SIZE", b"1e9"), "does not say where its XML block is"),
    (stated(b"XML_BLOCK_SIZE", b"10"), "metadata that are not valid XML"),
    (stated(b"SIGNAL_BLOCK_SIZE", b"99999"), "is truncated"),
    (stated(b"SIGNAL_BLOCK_SIZE", b"100"), "more than its SIGNAL block holds"),
    (changed("</Global>", "</Globe>"), "metadata that are not valid XML"),
    (changed("^", BOMB + "]>"), "DOCTYPE|no XML"),
    (changed("^", '<!DOCTYPE a SYSTEM "file:///etc/passwd">'), "DOCTYPE"),
    (changed('exponent1="1"', 'exponent1="400000000"'), "exponent '400000000'"),
    (changed("<CPHD .*", "<a/>"), "holds 'a', not the metadata of a CPHD"),
    (changed("cphd/1.1.0", "cphd/1.2.0"), "is CPHD of 'http.*1.2.0'; 1.0.1 and 1.1.0 are read"),
    (changed("MONOSTATIC", "BISTATIC"), "is 'bistatic'; only collections whose radar transmits and receives"),
    (changed("<Data>.*</Data>", ""), "no channels in its metadata"),
    (changed("<NumBytesP", "<SignalCompressionID>zip</SignalCompressionID><NumBytesP"), "compressed signals .'zip'"),
    (changed("CF8", "CF16"), "samples of the format 'CF16'; CI2, CI4"),
    (changed("<NumVectors>40", "<NumVectors>41"), "more than its PVP block holds"),
    (changed("<NumVectors>40", "<NumVectors>-1"), "has '-1' as NumVectors"),
    (changed("<NumVectors>40", "<NumVectors>1"), "1 pulse with a signal"),
    (changed("<NumSamples>32", "<NumSamples>33"), "more than its SIGNAL block holds"),
    (changed("<NumBytesPVP>[0-9]+", "<NumBytesPVP>80"), "not a valid CPHD"),
    (changed("Channel A", "Channel ' A"), "which is no name"),
    (changed("<SRPPos>.*</SRPPos>", ""), "lacks SRPPos of its pulses"),
    (changed("<FX1>(.*?)F8", r"<FX1>\1X=F8;Y=F8;Z=F8;"), "not a valid CPHD|FX1 is impossible"),
    (changed("<DomainType>FX", "<DomainType>XF"), "the domain 'XF'"),
    (changed("<SGN>-1", "<SGN>2"), "sign 2"),
    (changed("<IARP>.*</IARP>", ""), "no valid reference point"),
    (changed("<ECF><X>[^<]*", "<ECF><X>nan"), "no valid reference point"),
    (changed("<ECF><X>[^<]*", "<ECF><X>9e9"), "the reference point of the scene: the height"),
    (changed("<uIAX>.*</uIAY>", ""), "not a valid CPHD"),
    (changed("<ImageArea>.*</ImageArea>", ""), "no valid ImageArea"),
    (changed("<Dwell>.*</Dwell>", ""), "no dwell times"),
    (changed("<CODId>c", "<CODId>e"), "no dwell times .CODTime."),
    (changed("(<CODTimePoly.*?exponent2=.0.>)[^<]*", r"\g<1>1e5"), "no pulses saw all of the image"),
    (changed("(<CODTimePoly.*?exponent2=.0.>)[^<]*", r"\1inf"), "dwell times that are not finite"),
]  # fmt: skip
RECORDED = [
    (recorded(moved=np.tile([100.0, 0, 0], (40, 1))), r"sent and received 1\.\d° apart .*bistatic"),
    (recorded(scaled=np.where(np.arange(40) == 7, np.nan, 1.0)), "pulses whose AmpSF is impossible, such as nan"),
    (recorded([((0.0, 0.0, 0.0), 1e12)]), "holds a sample of .*; it must be finite and at most"),
    (recorded(srp=np.full((40, 3), np.nan)), "pulses whose RcvTime is impossible, such as nan"),
    (recorded(signal=np.zeros(40)), "0 pulses with a signal"),
    (recorded(shift=np.linspace(0, 20, 40)), "all have only .* in common"),
    (recorded(swath=1.0), r"reaches from -?\d.* but the file shows -1\.0 m to 1\.0 m"),
    (recorded(antenna=-ARC), "not above"),
    (recorded(antenna=ARC[[*range(20), *range(18, 38)]]), "turns back after pulse"),
    (recorded(stretch=-1.0), "must be positive"),
    (recorded(domain="TOA", shift=np.linspace(0, 20, 40)), "all have only .* in common"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "told"), [*SPOILT, *RECORDED])
def test_bad_files_are_refused_in_a_sentence(tmp_path, capfd, spoil, told):
    path = write_cphd(tmp_path / "a.cphd", MADE, POINTS)
    data = path.read_bytes()
    with np.errstate(all="ignore"):
        path.write_bytes(spoil(data, path) if (spoil, told) in RECORDED else spoil(data))
    check_spoilt(["phase-history", str(path), "--size", "6"], tmp_path / "set", told, capfd)


def test_worlds_are_not_mixed(tmp_path, capsys):
    placed = write_cphd(tmp_path / "a.cphd", MADE, POINTS)
    other = write(tmp_path / "b.mat", record(circle(np.linspace(-1, 1, 20)), [(0, 0, 0)]))
    out = ["--size", "4", "--out", str(tmp_path / "out")]
    place = [f"--place={PLACE.latitude_deg},{PLACE.longitude_deg}"]
    for words, told in (
        ([str(placed), str(other)], "b.mat has no place on earth; import files"),
        ([str(other), *place], "b.mat has no place on earth; leave out --place"),
        ([str(other), "--channel", "HH"], "b.mat has no channels .*, so leave out --channel"),
        ([str(placed), "--place=95,8"], "latitude_deg 95.0 of a place on earth"),
        ([str(placed), "--place=47,8"], "shows 1000 m × 1000 m about"),
    ):
        assert main(["import", "phase-history", *words, *out]) == 2
        assert re.search(told, capsys.readouterr().err)


def test_damaged_files_are_not_described(tmp_path, capsys):
    data = write_cphd(tmp_path / "a.cphd", MADE, POINTS).read_bytes()
    (tmp_path / "b.cphd").write_bytes(data[:-9])
    assert main(["info", str(tmp_path / "b.cphd")]) == 2
    assert "is truncated" in capsys.readouterr().err
