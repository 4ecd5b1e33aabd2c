"""A folder of images is recognised, and the command that imports it can be typed as it stands."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from chip_files import ROWS, phoenix_bytes, write_chips
from sarsplat.cli import main
from sarsplat.errors import SarsplatError
from sarsplat.importers.recognise import recognised


@pytest.fixture
def chips(tmp_path: Path) -> Path:
    folder = tmp_path / "my chips"  # a name that must be quoted
    folder.mkdir()
    write_chips(folder, ROWS)
    return folder


def typed(command: str | None, out: Path) -> int:
    """Carry out what was proposed, elsewhere."""
    assert command is not None
    program, *words = shlex.split(command)
    assert program == "sarsplat"
    words[words.index("--out") + 1] = str(out)
    return main(words)


def test_labelled_jpegs(chips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = recognised(chips)
    assert found is not None
    assert found.facts["chips"] == "11"
    assert found.facts["class T72"] == "8 at 17°, 2 at 15°"
    assert found.command is not None
    assert "--class T72 --train-views 4" in found.command
    assert main(["info", str(chips)]) == 0
    assert f"import with: {found.command}\n" in capsys.readouterr().out
    assert typed(found.command, tmp_path / "out") == 0
    assert (tmp_path / "out" / "dataset.json").is_file()


def test_the_table_itself_and_a_subfolder_lead_to_the_same(chips: Path, tmp_path: Path) -> None:
    below = recognised(chips / "BMP2")
    assert below is not None
    assert below.facts["chips"] == "1"
    assert f"{shlex.quote(str(chips))} --labels {shlex.quote(str(chips / 'labels.csv'))} --class BMP2" in str(
        below.command
    )
    assert main(["info", str(chips / "labels.csv")]) == 0


def test_another_depression_is_asked_for(chips: Path, tmp_path: Path) -> None:
    table = chips / "labels.csv"
    table.write_text(table.read_text().replace(",17,17.1,", ",30,30.1,"))
    found = recognised(chips)
    assert found is not None
    assert "--train-depression 30" in str(found.command)
    assert typed(found.command, tmp_path / "out") == 0


def test_jpegs_without_labels(chips: Path) -> None:
    (chips / "labels.csv").write_text("name,number\n1,2\n")
    found = recognised(chips)
    assert found is not None
    assert found.kind == "11 JPEGs without a table of labels"
    assert "target_az_deg" in found.facts["missing"]
    assert "--labels labels.csv --class NAME" in str(found.command)


def test_phoenix_files(tmp_path: Path) -> None:
    folder = tmp_path / "phoenix"
    folder.mkdir()
    for k in range(4):
        (folder / f"HB0000{k}.015").write_bytes(phoenix_bytes(TargetAz=90.0 * k))
    found = recognised(folder)
    assert found is not None
    assert found.kind == "original MSTAR chips (Phoenix files)"
    assert typed(found.command, tmp_path / "out") == 0


def test_no_images_are_nothing(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    assert recognised(tmp_path) is None


def test_a_damaged_table_is_told_in_one_sentence(chips: Path) -> None:
    (chips / "labels.csv").write_text("path,class\n")
    with pytest.raises(SarsplatError, match="is missing the column 'serial'"):
        recognised(chips)
