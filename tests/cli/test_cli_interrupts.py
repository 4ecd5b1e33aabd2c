"""Ctrl-C and a polite kill while the surface is extracted: one is enough, and the run resumes from there."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from datasets import dataset_of
from sarsplat import ImageGrid, Run, View
from sarsplat.data import write_dataset

SIGNALLED = """
import os, signal, sys
from sarsplat.cli import main
from sarsplat.reconstruction import normals, points, seen
module, name, count = sys.argv[1:4]
usual = getattr(globals()[module], name)
calls = []
def until(*arguments, **options):
    calls.append(1)
    if len(calls) == int(count):
        os.kill(os.getpid(), getattr(signal, sys.argv[4]))
    return usual(*arguments, **options)
setattr(globals()[module], name, until)
sys.exit(main(sys.argv[5:]))
"""


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
        (("points", "render", 3), "SIGINT"),
        (("points", "render", 3), "SIGTERM"),
        (("seen", "render", 2), "SIGINT"),
        (("normals", "csr_array", 1), "SIGINT"),
    ],
)
def test_one_signal_ends_the_extraction_and_the_run_resumes(
    dataset: Path, tmp_path: Path, where: tuple[str, str, int], number: str
) -> None:
    words = ["reconstruct", str(dataset), "--preset", "quick", "--gaussians", "40", "--iterations", "4", "--out"]

    def run(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)

    out = tmp_path / "run"
    done = run(SIGNALLED, *where, number, *words, out)
    assert done.returncode == 128 + getattr(signal, number), done.stderr
    message = " ".join(done.stderr.split())
    assert f"{out} keeps the progress so far; continue with `sarsplat reconstruct" in message
    assert "Traceback" not in message
    assert Run.load(out).iteration == 4
    assert not (out / "points.ply").exists()
    plain = "import sys; from sarsplat.cli import main; sys.exit(main(sys.argv[1:]))"
    resumed = run(plain, *words, out, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert " s of training; quick, seed 0)" in " ".join(resumed.stdout.split())
    assert (out / "points.ply").is_file()
