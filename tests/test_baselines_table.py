"""`make baselines`: what is finished is not done again, and the page says what the cells hold."""

from __future__ import annotations

import csv
import json
import re
from types import ModuleType

import numpy as np
import pytest

from programs import ROOT, python

PROGRAM = ROOT / "experiments" / "baselines.py"


@pytest.fixture
def baselines(module) -> ModuleType:
    return module("experiments/baselines")


def finished(comparison, cell, psnr: float, time_s: float) -> None:
    """Leaves what a cell leaves."""
    path = comparison.path(cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    scores = {"psnr_db": psnr, "psnr_target_db": psnr - 8, "ssim": 0.9, "lpips": None}
    points = {"cd_m": 0.2, "f1@0.3": 0.8, "f1@0.1": None}
    found = {
        "images": {"test": scores},
        "points": {"visible": points},
        "reasons": {"images.test.lpips": "no LPIPS weights", "points.visible.f1@0.1": "no mesh"},
        "time_s": time_s,
        "iterations": 100,
        "peak_bytes": 500_000_000,
        "curve": [{"seconds": time_s / 2, "images": {"test": scores}, "points": {"visible": points}}],
    }
    path.write_text(json.dumps(found))
    pictures = {name: np.full((2, 8, 8), 0.5, np.float32) for name in ("images", "truth")}
    np.savez(path.with_suffix(".npz"), points=np.zeros((5, 3)), **pictures)


def test_the_page_says_what_is_finished(baselines, tmp_path):
    images = baselines.simulated("btr70", "raycast", small=False)
    comparison = baselines.Comparison([images], [images.name], [0, 1], tmp_path, tmp_path / "out", small=False)
    ours, *_ = comparison.bouts(images)
    for cell, psnr in zip(ours.cells, (40.0, 42.0), strict=True):
        finished(comparison, cell, psnr, 50.0)
    bouts = [*comparison.bouts(images)]
    equal = next(bout for bout in bouts if bout.equal)
    assert equal.contender.method == "sar-nerf-grid"
    assert [cell.seconds for cell in equal.cells] == [50.0, 50.0]
    finished(comparison, equal.cells[0], 30.0, 49.0)

    baselines.write(comparison)
    page = (tmp_path / "out" / "baselines.md").read_text()
    assert "| sarsplat | 41.00 ± 1.41 | 33.00 ± 1.41 | 0.9000 ± 0.0000 | – | 0.200 ± 0.000 |" in page
    assert "| SAR-NeRF on a grid, sound, in our time | 30.00 | 22.00 |" in page
    assert "| *paper: SAR-NeRF* | 34.54 | – | 0.9911 | 0.0224 |" in page
    assert "DSR, full" not in page
    who = "sarsplat: LPIPS; SAR-NeRF on a grid, sound, in our time: LPIPS"
    assert f"\n–: no LPIPS weights ({who}).\n" in page
    with (tmp_path / "out" / "baselines-runs.csv").open() as file:
        runs = [*csv.DictReader(file)]
    assert [(run["method"], run["budget"], run["seed"], run["psnr_db"]) for run in runs] == [
        ("sarsplat", "full", "0", "40.0"),
        ("sarsplat", "full", "1", "42.0"),
        ("SAR-NeRF on a grid, sound", "in our time", "0", "30.0"),
    ]
    assert "**Not complete:** 3 of at least 18 trainings are finished" in page
    assert "A baseline is the best" not in page
    finished(comparison, equal.cells[0], 43.0, 49.0)
    baselines.write(comparison)
    page = (tmp_path / "out" / "baselines.md").read_text()
    assert "A baseline is the best in: PSNR, whole image (SAR-NeRF on a grid, sound, in our time); " in page
    for name in re.findall(r"!\[.*?\]\((.*?)\)", page):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out" / "baselines.png").is_file()


def test_what_another_machine_finished_counts_too(baselines, tmp_path):
    images = baselines.simulated("btr70", "raycast", small=False)

    def comparison(machine: str):
        return baselines.Comparison([images], [], [0, 1], tmp_path / machine, tmp_path / "out", small=False)

    first = comparison("first")
    ours, *_ = first.bouts(images)
    finished(first, ours.cells[0], 40.0, 50.0)
    baselines.write(first)
    picture = (tmp_path / "out" / "baselines-btr70-by-ray-casting.png").read_bytes()
    second = comparison("second")
    ours, equal, *_ = second.bouts(images)
    assert (second.is_here(ours.cells[0]), second.read(ours.cells[1])) == (False, None)
    assert equal.cells[0].seconds == 50.0
    finished(second, ours.cells[1], 42.0, 55.0)
    finished(second, equal.cells[0], 30.0, 49.0)
    page = baselines.write(second).read_text()
    assert "| sarsplat | 41.00 ± 1.41 | 33.00 ± 1.41 |" in page
    assert (tmp_path / "out" / "baselines-btr70-by-ray-casting.png").read_bytes() == picture
    assert "](baselines-btr70-by-ray-casting.png)" in page


def test_what_is_finished_is_not_done_again(baselines, tmp_path, monkeypatch):
    images = baselines.simulated("t72", "raycast", small=True)
    comparison = baselines.Comparison([images], [], [0], tmp_path, tmp_path / "out", small=True)
    monkeypatch.setattr(baselines, "Bench", lambda *arguments: type("Made", (), {"masks": tmp_path}))
    asked = []

    def run(self, cell, what, failed):
        asked.append(what)
        finished(comparison, cell, 30.0, 5.0)

    monkeypatch.setattr(baselines.Comparison, "_run", run)
    assert comparison.run(processes=2) == []
    assert asked[0] == "t72, by ray casting, sarsplat, seed 0"
    assert "t72, by ray casting, DSR, in our time, seed 0" in asked
    before = len(asked)
    comparison.run(processes=2)
    assert len(asked) == before


def test_half_of_what_measured_chips_need_is_refused():
    done = python(PROGRAM, "--quick", "--chips", "nowhere")
    assert done.returncode == 2
    assert "need --chips, --labels and --masks together" in done.stderr


@pytest.mark.slow
def test_everything_works_in_small(tmp_path):
    done = python(PROGRAM, "--quick", "--work", tmp_path, timeout=None)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "quick" / "baselines.md").read_text()
    for method in ("sarsplat", "SAR-NeRF on a grid, sound, full", "DSR, full", "SAR-NeRF, published, full"):
        assert f"| {method} |" in page
