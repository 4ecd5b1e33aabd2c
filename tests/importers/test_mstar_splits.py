"""Standard splits of MSTAR: which chips they take, and what they say of those that are missing, doubled or unplaced."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from chip_files import phoenix_bytes, write_chips
from made_imports import rewrite
from sarsplat.cli import main
from sarsplat.cli.import_mstar import SplitSource, rows_of_all
from sarsplat.data import read_dataset
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.importers import import_mstar
from sarsplat.importers.mstar_splits import SPLITS, in_words
from sarsplat.samples import write_measured_chips
from sarsplat.samples.encoding import Encoding

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # those expected are named

VEHICLES = [("T72", "132", (17, 15)), ("BMP2", "9563", (17, 15)), ("BMP2", "9566", (17, 15)), ("T-72", "A64", (30,))]
"""Class as a table spells it, serial, depression angles: four chips of each."""


def chips_of() -> list[tuple[str, str, int, float | None]]:
    """Class, serial, depression and azimuth; one training chip of BMP2 has no azimuth."""
    rows: list[tuple[str, str, int, float | None]] = []
    for target, serial, depressions in VEHICLES:
        for depression in depressions:
            rows += [(target, serial, depression, 90.0 * k + (len(rows) + k) % 7) for k in range(4)]
    rows[11] = (*rows[11][:3], None)
    return rows


def jpegs(folder: Path) -> Path:
    """JPEGs by class, with their table."""
    folder.mkdir(parents=True)
    write_chips(folder, chips_of(), random=True)
    return folder


def phoenix(folder: Path, nested: bool = False) -> Path:
    """Original files, whose headers have all but a table's spelling: those without azimuth are left out."""
    for number, (target, serial, depression, azimuth) in enumerate(chips_of()):
        if azimuth is None:
            continue
        path = folder / (f"{depression}_DEG/{target}/SN_{serial}" if nested else "") / f"HB{number:05}.000"
        path.parent.mkdir(parents=True, exist_ok=True)
        header = {
            "TargetType": "bmp2_tank" if target == "BMP2" else "t72_tank",
            "TargetSerNum": serial,
            "TargetAz": str(azimuth),
            "DesiredDepression": str(depression),
            "MeasuredDepression": str(depression + 0.1),
        }
        magnitude = np.random.default_rng(number).uniform(0.1, 1, (16, 16)).astype(np.float32)
        path.write_bytes(phoenix_bytes(magnitude, **header))
    return folder


@pytest.mark.parametrize("kind", ["jpeg", "phoenix", "phoenix by folders"])
def test_soc_takes_17_degrees_to_train_and_15_to_test_of_the_strict_vehicles(tmp_path: Path, kind: str) -> None:
    folder = jpegs(tmp_path / "chips") if kind == "jpeg" else phoenix(tmp_path / "chips", "folders" in kind)
    labels = folder / "labels.csv" if kind == "jpeg" else None
    options = {"labels": labels, "split": "soc"}
    with pytest.warns(SarsplatWarning, match=r"BMP2: left out 8 chips that the split soc has not \(4 of 9566 at 15°"):
        bmp2 = import_mstar(folder, tmp_path / "bmp2", target_class="BMP2", train_views="all", **options)
    assert bmp2.splits() == ("train", "test-15")
    assert [len(bmp2.images(name)) for name in bmp2.splits()] == [3, 4]
    train, test = bmp2.source["split"]["parts"]
    missing = 4 if kind == "jpeg" else 3
    assert (train["found"], train["published"], test["found"], test["published"]) == (missing, 233, 4, 195)
    said = list(in_words(bmp2.source["split"]["parts"]))
    assert said[1] == "test: BMP2 (9563) at 15°: 4 of 195 chips, 191 are missing"
    assert said[0].endswith("1 has no azimuth") == (kind == "jpeg")
    with pytest.warns(SarsplatWarning, match="4 of A64 at 30°"):
        t72 = import_mstar(folder, tmp_path / "t72", target_class="T72", train_views=2, **options)
    assert [len(t72.images(name)) for name in ("train", "test-17", "test-15")] == [2, 2, 4]


def test_extended_conditions_test_on_other_vehicles(tmp_path: Path) -> None:
    folder = jpegs(tmp_path / "chips")
    kept = {"labels": folder / "labels.csv", "train_views": "all"}
    with pytest.warns(SarsplatWarning, match="left out"):
        version = import_mstar(folder, tmp_path / "a", target_class="BMP2", split="eoc-version", **kept)
    assert version.splits() == ("train", "test-17-9566", "test-15-9566")
    with pytest.warns(SarsplatWarning, match="left out"):
        depression = import_mstar(folder, tmp_path / "b", target_class="T72", split="eoc-depression", **kept)
    assert depression.splits() == ("train", "test-30-a64")
    with pytest.raises(SarsplatError, match="split eoc-depression has no class BMP2; it has 2S1, BRDM2, T72, ZSU234"):
        import_mstar(folder, tmp_path / "c", target_class="BMP2", split="eoc-depression", **kept)


def test_chips_of_unnamed_vehicles_are_of_no_one_among_several(tmp_path: Path) -> None:
    folder = jpegs(tmp_path / "chips")
    table = folder / "labels.csv"
    table.write_text(table.read_text().replace(",9566,", ",,").replace(",9563,", ",,"))
    words = {"labels": table, "target_class": "BMP2", "train_views": "all"}
    with pytest.warns(SarsplatWarning, match="8 of an unnamed vehicle at 15°"):
        version = import_mstar(folder, tmp_path / "version", split="eoc-version", **words)
    assert [part["found"] for part in version.source["split"]["parts"]] == [8, 0, 0]
    assert version.splits() == ("train",)
    soc = import_mstar(folder, tmp_path / "soc", split="soc", **words)
    assert [part["found"] for part in soc.source["split"]["parts"]] == [8, 8]


def test_published_numbers_add_up() -> None:
    totals = {name: [sum(part.count for part in parts) for parts in (s.train, s.test)] for name, s in SPLITS.items()}
    assert totals["soc"] == [2747, 2425]
    assert totals["eoc-depression"][1] == 1151
    assert totals["eoc-configuration"][1] == 2710
    assert totals["eoc-version"][1] == 3569


def test_a_chip_that_is_there_twice_counts_once(tmp_path: Path) -> None:
    folder = phoenix(tmp_path / "chips", nested=True)
    shutil.copytree(folder / "17_DEG" / "T72", folder / "copies" / "T72")
    with pytest.warns(SarsplatWarning, match="T72: left out 4 chips lying in several folders, where each counts once"):
        t72 = import_mstar(folder, tmp_path / "t72", labels=None, target_class="T72", train_views="all", split="soc")
    assert len(t72.images("train")) == 4


def test_a_class_whose_training_chips_have_no_azimuth_is_refused(tmp_path: Path) -> None:
    folder = jpegs(tmp_path / "chips")
    table = folder / "labels.csv"
    rewrite(table, lambda rows: [rows[0], *([*row[:-1], ""] for row in rows[1:])])
    with pytest.raises(SarsplatError, match="no training chip of T72 has a target_az_deg"):
        import_mstar(folder, tmp_path / "a", labels=table, target_class="T72", train_views="all", split="soc")


def test_chips_without_azimuth_are_kept_on_the_scale_of_the_others(tmp_path: Path) -> None:
    folder = jpegs(tmp_path / "chips")
    options = {"labels": folder / "labels.csv", "target_class": "BMP2", "train_views": "all", "split": "soc"}
    planned = {"set": "train", "grazing_deg": 17.1, "serial": "9563", "depression_deg": 17}
    for mirrored in (False, True):
        bmp2 = import_mstar(folder, tmp_path / f"{mirrored}", mirrored=mirrored, **options)
        (one,) = bmp2.source["unplaced"]
        assert one == {"name": "BMP2/chip011.jpeg", "file": "unplaced/0000.tif", **planned}
        published = np.asarray(Image.open(folder / one["name"]), np.float32)
        turned = published[::-1, :] if mirrored else published[::-1, ::-1]
        power = tifffile.imread(bmp2.path / one["file"]) * bmp2.source["mean_power"]
        np.testing.assert_allclose(power, np.maximum(turned, 2) ** 2, rtol=1e-5)
        assert read_dataset(bmp2.path).fingerprint() == bmp2.fingerprint()


def test_chips_without_azimuth_are_of_the_same_sets_as_others_of_their_vehicle(tmp_path: Path) -> None:
    folder = jpegs(tmp_path / "chips")
    table = folder / "labels.csv"
    with table.open(newline="") as file:
        rows = [*csv.reader(file)]
    hidden = [row[2:4] == ["9566", "15"] and row[5].startswith("9") for row in rows]
    rows = [[*row[:5], "" if hide else row[5]] for row, hide in zip(rows, hidden, strict=True)]
    rewrite(table, lambda _: rows)
    kept = {"labels": table, "target_class": "BMP2", "split": "eoc-version"}
    every = import_mstar(folder, tmp_path / "every", train_views="all", **kept)
    assert every.splits() == ("train", "test-17-9566", "test-15-9566")
    unplaced = [(one["set"], one["serial"]) for one in every.source["unplaced"]]
    assert unplaced == [("train", "9563"), ("test-15-9566", "9566")]
    some = import_mstar(folder, tmp_path / "some", train_views=2, **kept)
    assert {one["set"] for one in some.source["unplaced"]} == {"test-17-9563", "test-15-9566"} <= {*some.splits()}
    write_measured_chips([tmp_path / "every"], tmp_path / "out", Encoding(format="png"))
    with (tmp_path / "out" / "labels.csv").open(newline="") as file:
        labelled = list(csv.DictReader(file))
    assert {row["split"] for row in labelled} == {"train", "test-17-9566", "test-15-9566"}
    for label in labelled:
        (published,) = [one for one in rows[1:] if one[0] == label["name"]]
        assert [label["serial"], label["desired_depression_deg"]] == published[2:4]


def test_one_command_makes_a_dataset_of_each_class_a_plan_and_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = jpegs(tmp_path / "chips"), tmp_path / "soc"
    words = ["import", "mstar", str(folder), "--labels", str(folder / "labels.csv"), "--train-views", "all"]
    words += ["--out", str(out)]
    assert main([*words, "--split", "soc"]) == 2  # eight classes are not there
    said = capsys.readouterr()
    assert "2S1: there is no class '2S1'" in said.err
    assert "train: 8 of 2,747 chips, 2 of 10 classes" in said.out + said.err
    assert "without 2S1, BRDM2, BTR60, BTR70, D7, T62, ZIL131, ZSU234 (see above)" in said.err
    assert "the same command with --class 2S1 BRDM2" in said.err
    assert "reading chips" not in said.out
    assert "10/10" in [line for line in said.out.splitlines() if line.startswith(f"import {folder}: ")][-1]
    assert len([line for line in said.out.splitlines() if line.startswith("next: ")]) == 2  # none for each class
    assert sorted(path.name for path in out.iterdir()) == ["BMP2", "T72", "sweep.toml"]
    assert main(["info", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "split soc 2 of 10 classes; 2S1, BRDM2, BTR60, BTR70, D7, T62, ZIL131, ZSU234 are missing" in said
    assert "train soc 8 of 2,747 chips" in said and "test soc 8 of 2,425 chips" in said
    assert "BMP2: train 4 of 233, test 4 of 195" in said
    assert "3 train, 4 test-15, 1 unplaced" in said and "1 chip without azimuth" in said
    assert f"sarsplat sweep {out / 'sweep.toml'} --out soc-runs" in said
    assert "write these two lines" not in said
    assert main(["info", str(out / "sweep.toml")]) == 0
    assert "a plan of a sweep" in capsys.readouterr().out
    assert main(["info", str(out / "BMP2")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "train: BMP2 (9563) at 17°: 4 of 233 chips, 229 are missing; 1 has no azimuth" in said
    (out / "sweep.toml").write_text("# changed")
    assert main([*words, "--split", "soc", "--overwrite"]) == 2
    assert (out / "sweep.toml").read_text() == "# changed"
    capsys.readouterr()
    assert main([*words[:-1], str(tmp_path / "none"), "--split", "soc", "--class", "D7"]) == 2
    said = capsys.readouterr()
    assert "D7: there is no class 'D7'" in said.err and "cannot write" not in said.err and "wrote" not in said.out
    assert main([*words, "--split", "soc", "--serial", "132"]) == 2
    assert "but --serial was given" in capsys.readouterr().err
    assert main(words) == 2
    assert "--class is missing" in capsys.readouterr().err


def test_a_class_that_fails_changes_nothing_and_can_be_added_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = jpegs(tmp_path / "chips"), tmp_path / "soc"
    table = folder / "labels.csv"
    whole = table.read_text()
    table.write_text(whole.replace(",BMP2,", ",BMP1,"))
    words = ["import", "mstar", str(folder), "--labels", str(table), "--train-views", "all", "--split", "soc"]
    words += ["--out", str(out), "--class", "T72", "BMP2"]
    assert main(words) == 2
    assert sorted(path.name for path in out.iterdir()) == ["T72", "sweep.toml"]  # nothing half-written
    table.write_text(whole)
    assert main([*words[:-2], "BMP2"]) == 0
    before = {path: path.read_bytes() for path in (out / "BMP2").rglob("*") if path.is_file()}
    table.write_text(whole.replace(",BMP2,", ",BMP1,"))
    capsys.readouterr()
    assert main([*words, "--overwrite"]) == 2
    assert f"{out / 'BMP2'} stays as it was" in " ".join(capsys.readouterr().err.split())
    assert {path: path.read_bytes() for path in (out / "BMP2").rglob("*") if path.is_file()} == before


def test_what_a_header_says_of_a_split_is_not_trusted() -> None:
    part = {"set": "train", "part": "D7 at 17°", "found": 1, "published": 2, "without_azimuth": 0}
    whole = SplitSource.of("D7", {"split": {"name": "soc", "parts": [part]}})
    assert whole is not None
    assert rows_of_all([whole])["train soc"] == "1 of 2,747 chips"
    for wrong in ({"found": "1"}, {"set": "else"}, {"published": None}, {"part": 3}):
        assert SplitSource.of("D7", {"split": {"name": "soc", "parts": [part | wrong]}}) is None
    for split in (None, 3, "soc", [], {"name": [], "parts": []}, {"name": "soc", "parts": ["a"]}, {"name": "own"}):
        assert SplitSource.of("D7", {"split": split}) is None
