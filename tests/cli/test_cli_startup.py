"""How soon a command begins: CPU time beside that of importing numpy here and now, and what it imports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from datasets import SMALL, small_dataset
from programs import python
from sarsplat import Gaussians, Harmonics, Run, View
from sarsplat.data import write_dataset

COMMAND = """
import sys, time
from sarsplat.cli import main
try:
    code = main(sys.argv[1:])
except SystemExit as end:
    code = end.code
print(code, *sorted({"tyro", "numpy", "torch", "scipy", "matplotlib", "torchmetrics", "trimesh"} & set(sys.modules)))
print(time.process_time())
"""

WITHOUT_TORCH = """
import os, sys
class Torch:
    def find_spec(self, name, *_):
        if name == "torch":
            os._exit(7)  # nothing is flushed here
sys.meta_path.insert(0, Torch())
from sarsplat.cli import main
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def numpy_s() -> float:
    """What importing numpy takes, s of CPU time."""
    program = "import time, numpy; print(time.process_time())"
    return min(float(python("-c", program).stdout) for _ in range(5))


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset, a finished run, an image, and a file of no known kind."""
    folder = tmp_path_factory.mktemp("places")
    write_dataset(folder / "dataset", small_dataset())
    one = Gaussians(*(torch.ones(1, k) for k in (3, 4, 3)), torch.ones(1), Harmonics(torch.ones(1, 1)))
    Run.from_gaussians(one, SMALL, [View(0, 30)]).save(folder / "run")
    (folder / "image.tif").write_bytes((folder / "dataset" / "images" / "000.tif").read_bytes())
    (folder / "file.unknown").write_text("?")
    return folder


def begun(words: Sequence[str], folder: Path, least_s: float) -> tuple[float, list[str], str]:
    """CPU time of a command, the least of up to five runs; its exit code and what is imported then; what it says."""
    taken = []
    while len(taken) < 5 and min(taken, default=least_s) >= least_s:
        *shown, ended, took_s = python("-c", COMMAND, *words, cwd=folder).stdout.splitlines()
        taken.append(float(took_s))
    return min(taken), ended.split(), "\n".join(shown)


@pytest.mark.parametrize(
    ("words", "times", "imported"),
    [
        ("--help", 2, []),
        ("info --help", 5, ["tyro"]),
        ("simulate --help", 5, ["tyro"]),
        ("import mstar --help", 5, ["tyro"]),
        ("reconstruct --help", 8, ["tyro"]),
    ],
)
def test_help_is_fast_and_imports_nothing_heavy(
    words: str, times: float, imported: list[str], numpy_s: float, tmp_path: Path
) -> None:
    took_s, ended, shown = begun(words.split(), tmp_path, times * numpy_s)
    assert ended == ["0", *imported]
    assert took_s < times * numpy_s
    assert shown.startswith(f"usage: sarsplat {words.removesuffix('--help')}[-h]")


@pytest.mark.parametrize(
    ("path", "code", "told"),
    [
        ("dataset", "0", "a dataset of 3 images"),
        ("run", "0", "learned     1 Gaussian"),
        ("run/points.ply", "0", "other columns  nx, ny, nz"),
        ("image.tif", "0", "a power image"),
        ("file.unknown", "2", ""),
    ],
)
def test_info_is_fast_and_imports_nothing_heavy(path: str, code: str, told: str, numpy_s: float, places: Path) -> None:
    took_s, ended, shown = begun(["info", path], places, 10 * numpy_s)
    assert ended == [code, "numpy", "tyro"]
    assert took_s < 10 * numpy_s
    assert told in shown


def test_a_reconstruction_says_what_it_reads_before_torch_is_imported(places: Path) -> None:
    done = python("-c", WITHOUT_TORCH, "reconstruct", "dataset", "--out", "run", cwd=places)
    assert done.returncode == 7, done.stderr
    assert done.stdout == "reading dataset: 3 images of unnamed, 1 of them to train on, 16 × 12 pixels\n"
