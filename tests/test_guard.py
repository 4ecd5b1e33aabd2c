"""`benchmarks/guard.py`: which scores of the demo count as worse."""

import json
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from programs import ROOT


@pytest.fixture
def guard(module) -> ModuleType:
    return module("benchmarks/guard")


def demo(folder: Path, psnr_db: float | None = 40.0, cd_m: float = 0.03, gaussians: int = 900) -> Path:
    """An evaluated run of made-up scores."""
    points = {"cd_m": cd_m, "f1@0.3": 0.9, "f1@0.1": 0.8, "count": 1000}
    surfaces = {"visible": points, "whole": points}
    images = {"psnr_db": psnr_db, "psnr_target_db": 30.0, "ssim": 0.99, "lpips": None}
    metrics: dict[str, Any] = {"images": {"test": images}, "points": surfaces, "mesh": surfaces, "time_s": 7.0}
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "metrics.jsonl").write_text(f'{{"iteration": 4}}\n{{"iteration": 8, "gaussians": {gaussians}}}\n')
    return folder


@pytest.mark.parametrize(
    ("changes", "name", "verdict", "fine"),
    [
        ({}, "images.test.psnr_db", "", True),
        ({"psnr_db": 40.4}, "images.test.psnr_db", "", True),  # within five times the range of the seeds
        ({"psnr_db": 41.0}, "images.test.psnr_db", "better, +0.5 past its band", True),
        ({"psnr_db": 39.0}, "images.test.psnr_db", "WORSE, -0.5 past its band", False),
        ({"cd_m": 0.01}, "points.visible.cd_m", "better, -0.02 past its band", True),
        ({"cd_m": 0.05}, "mesh.whole.cd_m", "WORSE, +0.02 past its band", False),
        ({"gaussians": 901}, "gaussians", "WORSE, +1 past its band", False),
        ({"gaussians": 899}, "gaussians", "WORSE, -1 past its band", False),
        ({"psnr_db": None}, "images.test.psnr_db", "missing", False),
    ],
)
def test_a_score_that_leaves_its_band_is_named(guard, tmp_path, changes, name, verdict, fine):
    seeds = [guard.scores(demo(tmp_path / f"{psnr_db}", psnr_db)) for psnr_db in (39.9, 40.0, 40.1)]
    lines, passed = guard.compare(guard.scores(demo(tmp_path / "run", **changes)), guard.bands(seeds))
    assert passed == fine
    (line,) = (line for line in lines if line.split()[:1] == [name])
    assert line.split(maxsplit=4)[4:] == ([verdict] if verdict else [])
    assert len(lines) == 2 + len(guard.BETTER)
    assert "7  not judged" in lines[-1]


def test_a_run_of_former_code_is_not_judged(guard, tmp_path):
    """Whenever it was evaluated."""
    run, kernel = demo(tmp_path / "run"), tmp_path / "src" / "csrc" / "kernel.cuh"
    checkpoint = run / "checkpoints" / "00000900.safetensors"
    for file in (checkpoint, kernel):
        file.parent.mkdir(parents=True)
        file.touch()
    trained = (run / "metrics.json").stat().st_mtime - 60
    os.utime(checkpoint, (trained, trained))
    for name, age_s, found in (("kernel.cuh", 5, None), ("notes.txt", -5, None), ("kernel.cuh", -5, kernel)):
        file = kernel.with_name(name)
        file.touch()
        os.utime(file, (trained - age_s, trained - age_s))
        assert guard.newer(run, tmp_path / "src") == found


def test_no_share_is_held_against_more_than_one(guard):
    lines, fine = guard.compare({"images.test.ssim": 1.0}, {"images.test.ssim": [0.9, 1.3]})
    assert fine
    assert lines[1].split()[1:] == ["1", "0.9", "1"]


def test_the_stored_bands_are_of_what_is_judged(guard):
    stored = json.loads((ROOT / "benchmarks" / "results" / "demo.json").read_text(encoding="utf-8"))
    assert stored["bands"].keys() == guard.BETTER.keys()
    assert stored["widened"] == guard.WIDENED
    assert all(low <= high for low, high in stored["bands"].values())
