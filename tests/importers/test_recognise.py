"""`sarsplat info FOLDER` says which import fits, and its command can be typed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from chip_files import MAGNITUDE, ROWS, phoenix_bytes, write_chips
from pulses import circle, record
from pulses import write as write_pulses
from sample_files import write_sample
from sarsplat import preset
from sarsplat.cli import main
from sarsplat.cli.importers import Recognised, recognised
from sarsplat.errors import SarsplatError
from sicds import Track, write_sicd
from terrains import write_geotiff

pytestmark = pytest.mark.usefixtures("undrawn")

POWER = np.random.default_rng(0).gamma(1.0, size=(4, 12, 10)).astype(np.float32) + 0.1


def known(path: Path) -> Recognised:
    it = recognised(path)
    assert it is not None
    return it


def typed(command: str | None, out: Path, **words: str) -> int:
    """Carry out what was proposed, elsewhere, with words in capitals replaced."""
    assert command is not None
    program, *rest = shlex.split(command)
    assert program == "sarsplat"
    rest = [words.get(word, word) for word in rest]
    rest[rest.index("--out") + 1] = str(out)
    return main(rest)


@pytest.fixture
def chips(tmp_path: Path) -> Path:
    folder = tmp_path / "my chips"  # a name that must be quoted
    folder.mkdir()
    write_chips(folder, ROWS)
    return folder


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    folder = tmp_path / "my shots"  # a name that must be quoted
    folder.mkdir()
    for index, image in enumerate(POWER):
        Image.fromarray((image * 40).astype(np.uint8)).save(folder / f"{index}.png")
    (folder / "t.csv").write_text("file;Azimuth (deg)\n" + "".join(f"{k}.png;{90 * k}\n" for k in range(4)))
    return folder


def test_pictures_with_a_table(shots, tmp_path, capsys):
    it = known(shots)
    assert it.kind == "pictures with a table of their angles"
    assert it.facts["columns"] == "file = file, azimuth = Azimuth (deg)"
    assert "--grazing DEGREES --spacing METRES" in str(it.command)
    assert main(["info", str(shots)]) == 0
    assert f"import with: {it.command}\n" in capsys.readouterr().out
    assert typed(it.command, tmp_path / "out", DEGREES="30", METRES="0.2") == 0
    assert (tmp_path / "out" / "dataset.json").is_file()


def test_reconstruct_leads_to_the_import(shots, capsys):
    assert main(["reconstruct", str(shots), "--out", str(shots / "run")]) == 2
    told = capsys.readouterr().err
    assert f"`sarsplat info {shots}` says how to import images in it, such as with `sarsplat import folder`" in told


def test_pictures_without_a_table(shots):
    (shots / "t.csv").write_text("some,thing\n1,2\n")
    it = known(shots)
    assert it.kind == "pictures with a table"
    assert it.facts["missing"] == "which column is the file and which the azimuth; it has some, thing"
    assert "--columns file=NAME,azimuth=NAME --grazing DEGREES --spacing METRES" in str(it.command)
    (shots / "u.csv").write_text("some,thing\n1,2\n")
    it = known(shots)
    assert it.facts["missing"] == f"which of 2 tables is theirs: {shots / 't.csv'}, {shots / 'u.csv'}"
    for table in ("t.csv", "u.csv"):
        (shots / table).unlink()
    it = known(shots)
    assert it.kind == "4 pictures (4 .png) without a table of their angles"
    assert "the columns file, azimuth, grazing, spacing" in it.facts["missing"]
    assert "--table TABLE.csv" in str(it.command)


def test_a_table_that_is_not_in_utf_8(shots):
    (shots / "t.csv").write_bytes("Höhe\n1\n".encode("latin-1"))
    it = known(shots)
    assert "byte 1 is not UTF-8; save" in it.facts["table"]


def test_a_table_with_columns_of_other_names(tmp_path):
    shots = tmp_path / "shots"
    shots.mkdir()
    Image.fromarray(np.ones((5, 4), np.uint8)).save(shots / "a.png")
    (shots / "flights.csv").write_text("picture,pointing,elev,comment\na.png,10,30,fine\n")
    it = known(shots)
    assert it.facts["missing"].endswith("it has picture, pointing, elev, comment")
    assert "azimuth=NAME --spacing METRES" in str(it.command)


def test_the_sample_set(tmp_path):
    for image, azimuth in zip(POWER, (11.0, 30.0, 44.0, 60.0), strict=True):
        write_sample(tmp_path / "set", image * (1 + 1j), azimuth)
    write_sample(tmp_path / "set", POWER[0] * (1 + 1j), 30.0, kind="synth", target="m1")
    it = known(tmp_path / "set")
    assert it.facts == {"class m1": "1 synthetic", "class t72": "4 real"}
    assert "--class t72 --kind real --train-views 2" in str(it.command)
    assert typed(it.command, tmp_path / "out") == 0


@pytest.mark.parametrize(("ending", "command"), [(".nitf", "import sicd"), (".NTF", "import sicd")])
def test_files_of_other_formats(tmp_path, ending, command):
    (tmp_path / "a b").mkdir()
    for k in range(3):
        (tmp_path / "a b" / f"{k}{ending}").write_bytes(b"\0")
    it = known(tmp_path)
    assert it.kind.startswith(f"3 {ending} files")
    assert f"sarsplat {command} {shlex.quote(str(tmp_path / 'a b'))}/*{ending} --size METRES" in str(it.command)


def test_what_is_in_a_matlab_file(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"img": np.ones((40, 30), complex), "note": "x"})
    it = known(path)
    assert (it.kind, it.facts["img"]) == ("a MATLAB file, which may be a picture", "40 × 30 numbers, complex128")
    assert "sarsplat import folder" in str(it.command)
    scipy.io.savemat(path, {"pointsDown": np.ones((50, 3))})
    it = known(path)
    assert (it.kind, it.command) == ("a MATLAB file, which holds no picture that can be imported", None)
    write_pulses(path, record(circle(np.linspace(0, 3, 20)), [(0.0, 0.0, 0.0)]))
    it = known(path)
    assert it.kind == "a .mat file, which may be phase history"
    assert "sarsplat import phase-history" in str(it.command)
    np.save(tmp_path / "a.npy", np.ones((40, 30)))
    assert known(tmp_path / "a.npy").kind == "a NumPy file, which may be a picture"


def test_a_tiff_of_others_may_be_a_picture(tmp_path, capsys):
    """Whether its numbers are power, nobody but who wrote it knows; of a complex one, `info` said to give power."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.ones((40, 30), np.complex64))
    assert (known(path).kind, known(path).facts) == (
        "a TIFF, which may be a picture",
        {"array": "40 × 30 numbers, complex64"},
    )
    assert "sarsplat import folder" in str(known(path).command)
    tifffile.imwrite(path, np.ones((4, 40, 30), np.float32), photometric="minisblack")
    assert known(path).kind == "a TIFF, which is no picture that can be imported"
    tifffile.imwrite(path, np.ones((40, 30), np.float32), software="sarsplat")
    assert recognised(path) is None
    write_geotiff(path, np.ones((40, 30), np.float32))
    assert main(["info", str(path)]) == 0
    assert "a map (GeoTIFF)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a.xyz", "exported for other programs; open it with"),
        ("a.geojson", "open it with QGIS"),
        ("a.las", "open it with CloudCompare"),
        ("a.ply.place.json", "says where on earth a.ply is"),
    ],
)
def test_what_is_only_exported_is_named_with_who_reads_it(tmp_path, capsys, name, told):
    (tmp_path / name).write_text("1 2 3")
    assert main(["info", str(tmp_path / name)]) == 2
    assert told in capsys.readouterr().err


def test_files_of_settings_are_told_from_those_of_others(tmp_path, capsys):
    (tmp_path / "pyproject.toml").write_text('[build-system]\nrequires = []\n[project]\nname = "mine"\n')
    assert main(["info", str(tmp_path / "pyproject.toml")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "is a TOML file that holds build-system, project, but no plan of a sweep, which names datasets" in said
    (tmp_path / "sweep.toml").write_text('datasets = ["*"]\nseeds = [0, 1]\n')
    assert main(["info", str(tmp_path / "sweep.toml")]) == 0
    assert "a plan of a sweep" in capsys.readouterr().out
    (tmp_path / "mine.json").write_text(json.dumps(preset("quick").as_dict()))
    assert main(["info", str(tmp_path / "mine.json")]) == 0
    assert "sarsplat reconstruct DATASET --config" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "mine.json").write_text("{}")
    assert main(["info", str(tmp_path / "mine.json")]) == 2


def test_a_map_in_degrees_is_described(tmp_path, capsys):
    degrees = (1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326)
    lies = [(33922, "d", 6, (0.0, 0.0, 0.0, 8.5, 60.0, 0.0), True)]
    tags = [*lies, (33550, "d", 3, (1e-4, 1e-4, 0.0), True), (34735, "H", len(degrees), degrees, True)]
    tifffile.imwrite(tmp_path / "a.tif", np.ones((9, 9), np.float32), metadata=None, extratags=tags)
    assert main(["info", str(tmp_path / "a.tif")]) == 0
    assert "0.0001° × 0.0001°, 5.58 m × 11.14 m at latitude 60°" in " ".join(capsys.readouterr().out.split())


def test_other_nitf_files_and_unknown_endings_are_named(tmp_path, capsys):
    (tmp_path / "old.ntf").write_bytes(b"NITF02.00" + bytes(900))
    assert main(["info", str(tmp_path / "old.ntf")]) == 2
    assert "is a NITF file of another version than 2.1, so it is not a SICD" in capsys.readouterr().err
    (tmp_path / "a.abc").write_text("1 2 3")
    assert main(["info", str(tmp_path / "a.abc")]) == 2
    assert "is not a file that this command recognises by its ending" in capsys.readouterr().err


def test_a_table_is_not_what_lies_beside_it(tmp_path):
    (tmp_path / "a.cphd").write_bytes(b"CPHD/1.1.0\n")
    (tmp_path / "results.csv").write_text("run,psnr\na,30\n")
    assert recognised(tmp_path) is not None
    assert recognised(tmp_path / "results.csv") is None


def test_no_images_are_nothing(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    assert recognised(tmp_path) is None


def test_labelled_jpegs(chips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    it = known(chips)
    assert it.facts["chips"] == "11"
    assert it.facts["class T72"] == "8 at 17°, 2 at 15°"
    assert it.command is not None
    assert "--class T72 --train-views 4" in it.command
    assert main(["info", str(chips)]) == 0
    assert f"import with: {it.command}\n" in capsys.readouterr().out
    assert typed(it.command, tmp_path / "out") == 0
    assert (tmp_path / "out" / "dataset.json").is_file()


def test_the_table_itself_and_a_subfolder_lead_to_the_same(chips: Path, tmp_path: Path) -> None:
    below = known(chips / "BMP2")
    assert below.facts["chips"] == "1"
    assert f"{shlex.quote(str(chips))} --labels {shlex.quote(str(chips / 'labels.csv'))} --class BMP2" in str(
        below.command
    )
    assert main(["info", str(chips / "labels.csv")]) == 0


def test_chips_of_a_standard_split_lead_to_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    classes = ("2S1", "BMP2", "BRDM_2", "BTR-60", "BTR70", "D7", "T62", "T72", "ZIL131", "ZSU_23_4")
    angles = ((17, 10), (17, 130), (15, 250), (17, ""))
    rows = [(name, "", depression, azimuth) for name in classes for depression, azimuth in angles]
    (tmp_path / "ten").mkdir()
    write_chips(tmp_path / "ten", rows)
    it = known(tmp_path / "ten")
    assert it.facts["class D7"] == "3 at 17°, 1 at 15° (1 without azimuth)"
    assert "--train-views 1 " in str(it.command)  # of the two that can be used
    assert typed(it.command, tmp_path / "one") == 0
    ((purpose, command),) = it.also.items()
    assert purpose == "or a dataset of each class of a standard split (soc, 10 of its 10 classes are here)"
    capsys.readouterr()
    assert main(["info", str(tmp_path / "ten" / "labels.csv")]) == 0
    assert f"{purpose}: {command}\n" in capsys.readouterr().out
    assert typed(command, tmp_path / "soc") != 2  # 1: such pictures contradict themselves
    assert len([*(tmp_path / "soc").glob("*/dataset.json")]) == 10


def test_another_depression_is_asked_for(chips: Path, tmp_path: Path) -> None:
    table = chips / "labels.csv"
    table.write_text(table.read_text().replace(",17,17.1,", ",30,30.1,"))
    it = known(chips)
    assert "--train-depression 30" in str(it.command)
    assert typed(it.command, tmp_path / "out") == 0


def test_phoenix_files(tmp_path: Path) -> None:
    folder = tmp_path / "phoenix"
    folder.mkdir()
    for k in range(4):
        (folder / f"HB0000{k}.015").write_bytes(phoenix_bytes(MAGNITUDE + k, TargetAz=90.0 * k))
    it = known(folder)
    assert it.kind == "original MSTAR chips (Phoenix files)"
    assert typed(it.command, tmp_path / "out") == 0
    for name in ("HB00000.014", "HB00009.015"):
        (folder / name).write_bytes(phoenix_bytes(MAGNITUDE)[:-10])
    damaged = known(folder)
    assert damaged.facts["chips"] == it.facts["chips"] == "4"
    assert [line.split(" ")[0] for line in damaged.facts["unusable"].splitlines()] == [
        *(str(folder / name) for name in ("HB00000.014", "HB00009.015"))
    ]
    for path in folder.iterdir():
        path.write_bytes(phoenix_bytes(MAGNITUDE)[:-10])
    with pytest.raises(SarsplatError, match=r"HB00000\.014 is truncated"):
        known(folder)


def test_of_measurements_the_first_that_can_be_read_is_described(tmp_path: Path) -> None:
    for folder in ("pulses", "sicds"):
        (tmp_path / folder).mkdir()
    write_pulses(tmp_path / "pulses" / "b.mat", record(circle(np.linspace(0, 3, 20)), [(0.0, 0.0, 0.0)]))
    (tmp_path / "pulses" / "a.mat").write_bytes((tmp_path / "pulses" / "b.mat").read_bytes()[:500])
    it = known(tmp_path / "pulses")
    assert it.kind == "2 .mat files, which may be phase history"
    assert "a.mat is damaged" in it.facts["unusable"]
    whole = write_sicd(tmp_path / "sicds" / "b.nitf", Track(), [(0, 0, 0)])
    (tmp_path / "sicds" / "a.nitf").write_bytes(whole.read_bytes()[:3000])
    it = known(tmp_path / "sicds")
    assert (it.facts["the first"], it.facts["collection"]) == (str(whole), "bearing 90")
    assert "a.nitf is truncated" in it.facts["unusable"]


def test_a_damaged_table_is_told_in_one_sentence(chips: Path) -> None:
    (chips / "labels.csv").write_text("path,class\n")
    with pytest.raises(SarsplatError, match="is missing the columns 'serial', "):
        recognised(chips)
