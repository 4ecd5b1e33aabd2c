"""How soon a command begins: CPU time beside that of importing numpy here and now, and what it imports."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest

from made import SMALL, small_dataset, upright
from programs import python
from sarsplat import Run, View
from sarsplat.data import write_dataset

COMMANDS = """
import contextlib, io, json, sys, time
begun_s = 0.0
from sarsplat.cli import main
for words in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        try:
            code = main(words.split())
        except SystemExit as end:
            code = end.code
    now_s = time.process_time()
    heavy = {"tyro", "numpy", "torch", "scipy", "matplotlib", "torchmetrics", "trimesh"} & set(sys.modules)
    print(json.dumps([code, sorted(heavy), now_s - begun_s, shown.getvalue()]))
    begun_s = now_s
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


@dataclass
class Begun:
    """A command that has ended."""

    code: int
    imported: list[str]
    took_s: float
    shown: str


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
    Run.from_gaussians(upright([1.0, 1.0, 1.0]), SMALL, [View(0, 30)]).save(folder / "run")
    (folder / "file.unknown").write_text("?")
    return folder


HELP = {"info --help": 5, "simulate --help": 5, "import mstar --help": 5, "reconstruct --help": 8}
"""Commands that import the same, and how many times as long as numpy each may take."""


def begun(commands: Iterable[str], folder: Path, slow: Callable[[str, float], bool]) -> dict[str, Begun]:
    """What commands say in one process, whose beginning is counted with each; asked up to five times if any is slow."""
    for _ in range(5):
        lines = python("-c", COMMANDS, *commands, cwd=folder).stdout.splitlines()
        found = [Begun(*json.loads(line)) for line in lines]
        for one in found[1:]:
            one.took_s += found[0].took_s
        asked = dict(zip(commands, found, strict=True))
        if not any(slow(words, one.took_s) for words, one in asked.items()):
            break
    return asked


@pytest.mark.parametrize(("limits", "imported"), [({"--help": 2}, []), (HELP, ["tyro"])], ids=["all", "one"])
def test_help_is_fast_and_imports_nothing_heavy(
    limits: dict[str, int], imported: list[str], numpy_s: float, tmp_path: Path
) -> None:
    def slow(words: str, took_s: float) -> bool:
        return took_s >= limits[words] * numpy_s

    for words, said in begun(limits, tmp_path, slow).items():
        assert (said.code, said.imported) == (0, imported), words
        assert not slow(words, said.took_s), words
        assert said.shown.startswith(f"usage: sarsplat {words.removesuffix('--help')}[-h]")


INFO = {
    "info dataset": (0, "a dataset of 3 images"),
    "info run": (0, "learned     1 Gaussian"),
    "info run/points.ply": (0, "other columns  nx, ny, nz"),
    "info file.unknown": (2, ""),
}


def test_info_is_fast_and_imports_nothing_heavy(numpy_s: float, places: Path) -> None:
    def slow(words: str, took_s: float) -> bool:
        return took_s >= 10 * numpy_s

    for words, said in begun(INFO, places, slow).items():
        code, told = INFO[words]
        assert (said.code, said.imported) == (code, ["numpy", "tyro"]), words
        assert not slow(words, said.took_s), words
        assert told in said.shown


def test_a_reconstruction_says_what_it_reads_before_torch_is_imported(places: Path) -> None:
    done = python("-c", WITHOUT_TORCH, "reconstruct", "dataset", "--out", "run", cwd=places)
    assert done.returncode == 7, done.stderr
    assert done.stdout == "reading dataset: 3 images of unnamed, 1 of them to train on, 16 × 12 pixels\n"
