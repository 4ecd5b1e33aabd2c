"""What `sarsplat info` says of a dataset's views, in letters and as a picture."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from datasets import dataset_of
from sarsplat.cli.sky import PLAIN, PRETTY, sky_chart, symbols_for
from sarsplat.data import Dataset, read_dataset, write_dataset
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(8, 8, (0.3, 0.3), (0.3, 0.3))
RING = [View(float(azimuth), 45.0) for azimuth in range(0, 360, 15) if not 100 < azimuth < 200]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    views = [(view, "train") for view in RING] + [(View(150, 30), "test")]
    images = np.random.default_rng(0).random((len(views), 8, 8), np.float32)
    write_dataset(tmp_path / "data", dataset_of(GRID, views, images))
    return tmp_path / "data"


def test_views_gap_and_chart(dataset: Path, said) -> None:
    told = said(f"info {dataset}")
    assert "largest gap        120°, from 90° clockwise to 210° (azimuths of the training views)" in told
    assert re.search(r"train +45° +17 +210° … 90°, clockwise +15° +120°", told)
    assert re.search(r"test +30° +1 +150° +– +–", told)
    assert "0° (nose)" in told


def rows(symbols=PRETTY, train=(), test=(), width=80) -> list[str]:
    return sky_chart(train, test, width, symbols).plain.splitlines()


def test_images_with_phase_say_so(dataset: Path, tmp_path: Path, said) -> None:
    power = read_dataset(dataset)
    write_dataset(tmp_path / "complex", Dataset.of_complex(GRID, power.entries, power.power.astype(np.complex64)))
    for path, told in ((dataset, "linear power, float32"), (tmp_path / "complex", "is β⁰, complex64")):
        assert told in said(f"info {path}")


def test_where_images_come_from_is_said_in_words(tmp_path: Path, said) -> None:
    source = {
        "kind": "phase-history",
        "around_m": [1.5, 2.0],
        "columns": {"azimuth": "heading"},
        "apertures": [{"name": "000", "pulses": 117}, {"name": "001", "pulses": 118}],
        "assumptions": ["the nose is at 0°", "the ground is flat"],
        "offset": 0.0,
    }
    one = dataset_of(GRID, [(RING[0], "train")], np.ones((1, 8, 8), np.float32), source=source)
    write_dataset(tmp_path / "data", one)
    lines = [" ".join(line.split()) for line in said(f"info {tmp_path}/data").splitlines()]
    first = lines.index("assumed the nose is at 0°")
    assert lines[first + 1] == "the ground is flat"
    assert "source.apertures 2, listed in dataset.json" in lines
    assert "source.around_m 1.5, 2.0" in lines
    assert "source.columns azimuth = heading" in lines
    assert not [line for line in lines if line.startswith("source.") and set(line) & set("[]{}'")]


def test_north_is_up_and_azimuths_go_clockwise() -> None:
    def place(view: View) -> tuple[int, int]:
        ((row, line),) = ((r, line) for r, line in enumerate(rows(train=[view])) if "●" in line)
        return row, line.index("●")

    up, right, down, left, middle = (place(View(*angles)) for angles in ((0, 5), (90, 5), (180, 5), (270, 5), (0, 89)))
    assert up[0] < right[0] == left[0] == middle[0] < down[0]
    assert left[1] < up[1] < right[1]
    assert abs(up[1] - middle[1]) <= 1 >= abs(down[1] - middle[1])


def test_narrow_terminals_and_few_letters() -> None:
    assert max(map(len, rows(width=40))) <= 40 < max(map(len, rows(width=80)))
    assert symbols_for("utf-8") is PRETTY
    assert symbols_for("ascii") is symbols_for("latin-1") is PLAIN
    chart = "\n".join(rows(PLAIN, train=RING, test=[View(150, 30)])).replace("°", "")
    assert chart.isascii()
    assert chart.count("o") >= len(RING) - 2  # and the o of nose
    assert chart.count("x") == 1
    assert Console(width=40).width == 40


def test_pictures(dataset: Path, tmp_path: Path, said, refused) -> None:
    pytest.importorskip("matplotlib")
    for _ in range(2):
        said(f"info {dataset} --plot {tmp_path}/sky.png")
        said(f"info {dataset} --plot {tmp_path}/sky.svg")
    assert (tmp_path / "sky.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "sky.svg").read_bytes()
    assert "does not end in .png or .svg" in refused(f"info {dataset} --plot {tmp_path}/sky.bmp")
    assert not (tmp_path / "sky.bmp").exists()
