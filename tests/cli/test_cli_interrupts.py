"""Ctrl-C and a polite kill while the surface is extracted: one is enough, and the run resumes from there."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat import ImageGrid, Run, View
from sarsplat.cli import main
from sarsplat.data import write_dataset
from sarsplat.surface import normals, points, visibility


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    images = np.zeros((6, 16, 16), np.float32)
    images[:, 6:10, 6:10] = np.random.default_rng(0).uniform(0.5, 1, size=(6, 4, 4))
    views = [(View(60.0 * k, 40.0), "train") for k in range(6)]
    write_dataset(tmp_path / "data", dataset_of(ImageGrid(16, 16, (0.3, 0.3), (0.4, 0.4)), views, images))
    return tmp_path / "data"


@pytest.mark.parametrize(
    ("where", "number"),
    [
        ((points, "render", 3), signal.SIGINT),
        ((points, "render", 3), signal.SIGTERM),
        ((visibility, "render", 2), signal.SIGINT),
        ((normals, "csr_array", 1), signal.SIGINT),
    ],
)
def test_one_signal_ends_the_extraction_and_the_run_resumes(
    dataset: Path,
    tmp_path: Path,
    where: tuple[ModuleType, str, int],
    number: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, (module, name, count) = tmp_path / "run", where
    words = ["reconstruct", str(dataset), "--preset", "quick", "--gaussians", "40", "--iterations", "4"]
    words += ["--points.voxel", "0.3", "--points.rays-per-pixel", "2", "--out", str(out)]
    usual, calls = getattr(module, name), []

    def until(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == count:
            os.kill(os.getpid(), number)
        return usual(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(module, name, until)
        assert main(words) == 128 + number
    message = " ".join(capsys.readouterr().err.split())
    assert f"{out} keeps the progress so far; continue with `sarsplat reconstruct" in message
    assert "Traceback" not in message
    assert Run.load(out).iteration == 4
    assert not (out / "points.ply").exists()
    assert main([*words, "--resume"]) == 0
    assert " s of training; quick, seed 0)" in " ".join(capsys.readouterr().out.split())
    assert (out / "points.ply").is_file()
