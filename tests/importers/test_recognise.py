"""`sarsplat info` says which importer reads a file or folder, and what is in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chip_files import MAGNITUDE, ROWS, phoenix_bytes, write_chips
from made import write_sample
from pulses import circle, record
from pulses import write as write_pulses
from sarsplat.cli import main
from sarsplat.cli.importers import Recognised, recognised
from sarsplat.errors import SarsplatError
from sicds import Track, write_sicd

POWER = np.random.default_rng(0).gamma(1.0, size=(4, 12, 10)).astype(np.float32) + 0.1


def known(path: Path, importer: str) -> Recognised:
    found = recognised(path)
    assert found is not None and found[0] == importer
    return found[1]


def test_pictures_with_a_table(tmp_path, capsys):
    Image.fromarray((POWER[0] * 40).astype(np.uint8)).save(tmp_path / "0.png")
    assert recognised(tmp_path) is None
    table = tmp_path / "t.csv"
    table.write_text("file;Azimuth (deg)\n0.png;90\n")
    assert known(tmp_path, "folder").facts["columns"] == "file = file, azimuth = Azimuth (deg)"
    assert main(["info", str(tmp_path)]) == 0
    assert "import with: sarsplat import folder (see sarsplat import folder --help)" in capsys.readouterr().out
    table.write_text("some,thing\n1,2\n")
    assert known(tmp_path, "folder").facts["columns"] == "some, thing"
    table.write_bytes("Höhe\n1\n".encode("latin-1"))
    assert "byte 1 is not UTF-8; save" in known(tmp_path, "folder").facts["table"]
    assert main(["reconstruct", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    assert f"by an import, which `sarsplat info {tmp_path}` recommends" in capsys.readouterr().err


def test_the_sample_set(tmp_path):
    for image, azimuth in zip(POWER, (11.0, 30.0, 44.0, 60.0), strict=True):
        write_sample(tmp_path, image * (1 + 1j), azimuth)
    write_sample(tmp_path, POWER[0] * (1 + 1j), 30.0, kind="synth", target="m1")
    assert known(tmp_path, "sample").facts == {"class m1": "1 synthetic", "class t72": "4 real"}


def test_labelled_jpegs(tmp_path):
    write_chips(tmp_path, ROWS)
    it = known(tmp_path, "mstar")
    assert (it.kind, it.facts["class T72"]) == ("MSTAR chips as JPEGs", "8 at 17°, 2 at 15°")


def test_phoenix_files(tmp_path):
    for k in range(4):
        (tmp_path / f"HB0000{k}.015").write_bytes(phoenix_bytes(MAGNITUDE + k, TargetAz=90.0 * k))
    assert known(tmp_path, "mstar").facts["chips"] == "4"
    (tmp_path / "HB00000.014").write_bytes(phoenix_bytes(MAGNITUDE)[:-10])
    with pytest.raises(SarsplatError, match=r"HB00000\.014 is truncated"):
        recognised(tmp_path)


def test_of_measurements_the_first_that_can_be_read_is_described(tmp_path):
    for folder in ("pulses", "sicds"):
        (tmp_path / folder).mkdir()
    write_pulses(tmp_path / "pulses" / "b.mat", record(circle(np.linspace(0, 3, 20)), [(0.0, 0.0, 0.0)]))
    (tmp_path / "pulses" / "a.mat").write_bytes((tmp_path / "pulses" / "b.mat").read_bytes()[:500])
    it = known(tmp_path / "pulses", "phase-history")
    assert (it.kind, it.facts) == ("phase history", {"the first": str(tmp_path / "pulses" / "b.mat")})
    whole = write_sicd(tmp_path / "sicds" / "b.nitf", Track(), [(0, 0, 0)])
    (tmp_path / "sicds" / "a.nitf").write_bytes(whole.read_bytes()[:3000])
    it = known(tmp_path / "sicds", "sicd")
    assert (it.facts["the first"], it.facts["collection"]) == (str(whole), "bearing 90")


@pytest.mark.parametrize("name", ["a.abc", "a.json", "a.csv", "a.las", "a.ply.place.json", "a.npy", "a.tif"])
def test_any_other_file_is_refused_in_one_sentence(tmp_path, capsys, name):
    (tmp_path / name).write_text("1 2 3")
    for path in (tmp_path / name, tmp_path):
        assert main(["info", str(path)]) == 2
        assert f"{path} cannot be described; give a dataset, a run," in " ".join(capsys.readouterr().err.split())


def test_settings_other_than_plans_are_not_described(tmp_path):
    (tmp_path / "sweep.toml").write_text('[project]\nname = "mine"\n')
    assert main(["info", str(tmp_path / "sweep.toml")]) == 2


def test_nitf_files_that_are_no_sicd_are_named(tmp_path, capsys):
    (tmp_path / "old.ntf").write_bytes(b"NITF02.00" + bytes(900))
    assert main(["info", str(tmp_path / "old.ntf")]) == 2
    assert "is not a NITF file of version 2.1, so it is not a SICD" in capsys.readouterr().err
