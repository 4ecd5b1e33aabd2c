"""`sarsplat chips`: what it writes and says, and what it refuses."""

from __future__ import annotations

import csv
import json
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from made_runs import GRID, made_up
from sarsplat.cli import main
from sarsplat.errors import SarsplatError
from sarsplat.importers.pictures import read_pixels
from sarsplat.samples import write
from sarsplat.samples.write import Made

Command = Callable[[str], str]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("runs")
    return " ".join(str(made_up(name, folder / name).folder) for name in ("box", "cone"))


def test_chips_in_folders_of_classes(runs: str, said: Command, refused: Command, tmp_path: Path) -> None:
    out = tmp_path / "set"
    text = said(f"chips {runs} --out {out} --count 3 --grazing 14.5:15.5 --crop 24")
    assert "6 chips of 2 classes, 24 × 24 pixels" in " ".join(text.split())
    with (out / "labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == ["box", "cone"] * 3
    assert all(14.5 <= float(row["grazing_deg"]) <= 15.5 for row in rows)
    for row in rows:
        assert read_pixels(out / row["path"]).shape == (24, 24)
    said(f"import folder {out} --class box --out {tmp_path / 'back'}")
    header = json.loads((out / "chips.json").read_text())
    for change, told in (({"count": -1}, "count is -1: expected"), ({"schema": None}, "its schema is None")):
        (out / "chips.json").write_text(json.dumps(header | change))
        with pytest.raises(SarsplatError, match=told):
            Made.read(out)


def test_azimuths_and_shards(runs: str, said: Command, tmp_path: Path) -> None:
    said(f"chips {runs} --out {tmp_path / 'set'} --azimuth 0:360:120 --shard 4 --format png")
    assert sorted(path.name for path in (tmp_path / "set").glob("*.tar")) == ["chips-000000.tar", "chips-000001.tar"]
    with (tmp_path / "set" / "labels.csv").open(newline="") as file:
        assert [float(row["azimuth_deg"]) for row in csv.DictReader(file)] == [0, 0, 120, 120, 240, 240]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--grazing 20:10", "grazing 20:10 goes down"),
        ("--grazing 1:2:3", "--grazing '1:2:3' is not 1 or 2 numbers; write it as 14.5:17.5"),
        ("--crop 64", "crop is 64, but the images of the runs have 32 × 36 pixels"),
        ("--scale calibrated", "choose npy"),
        ("--ground nowhere.png", "nowhere.png"),
        ("--count 0", "count is 0"),
        ("--shard 0", "shard is 0"),
        ("--seed -1", "seed -1 must be at least 0"),
    ],
)
def test_what_is_refused_leaves_nothing(runs: str, refused: Command, tmp_path: Path, options: str, words: str) -> None:
    assert words in refused(f"chips {runs} --out {tmp_path / 'set'} {options}")
    assert not list(tmp_path.iterdir())


def test_runs_that_cannot_be_drawn_from(runs: str, refused: Command, tmp_path: Path) -> None:
    out = tmp_path / "set"
    other = made_up("other", tmp_path / "other", replace(GRID, rows=30)).folder
    assert "cut all to one size, by a crop of at most 30" in refused(f"chips {runs} {other} --out {out}")
    (out / "mine").mkdir(parents=True)
    assert "already exists" in refused(f"chips {runs} --out {out}")
    assert "contains no chips.json, so it will not be replaced" in refused(f"chips {runs} --out {out} --overwrite")


def test_stopped_it_says_how_to_go_on(
    runs: str,
    said: Command,
    refused: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "set"

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(write, "_table", stop)
        assert main(f"chips {runs} --out {out} --count 1".split()) == 128 + signal.SIGINT
    assert "the same command goes on from there" in capsys.readouterr().err
    assert not out.exists()
    other = refused(f"chips {runs} --out {out} --count 2")
    assert "differs in count (1, not 2); go on with it by the command that began it" in other
    assert "or pass --overwrite to begin anew" in other
    said(f"chips {runs} --out {out} --count 1")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
