"""Commands that must succeed or be refused, and a small target for them."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import trimesh

from sarsplat.cli import main

Command = Callable[[str | Sequence[str]], str]


@pytest.fixture
def ended(capsys: pytest.CaptureFixture[str]) -> Callable[[str | Sequence[str], int], tuple[str, str]]:
    """What a command that ends with this code says on stdout and on stderr."""

    def run(words: str | Sequence[str], code: int) -> tuple[str, str]:
        capsys.readouterr()
        assert main(words.split() if isinstance(words, str) else words) == code
        return capsys.readouterr()

    return run


@pytest.fixture
def said(ended) -> Command:
    """What a command that succeeds says on stdout."""
    return lambda words: ended(words, 0)[0]


@pytest.fixture
def warned(ended) -> Command:
    """What a command that succeeds says on stderr, on one line."""
    return lambda words: " ".join(ended(words, 0)[1].split())


@pytest.fixture
def refused(ended) -> Command:
    """What is said to a command that is refused: one sentence."""

    def run(words: str | Sequence[str]) -> str:
        _, complaint = ended(words, 2)
        assert complaint.startswith("error: ")
        assert complaint.count("\n") == 1
        return complaint

    return run


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `box.obj`, 2.4 m long."""
    folder = tmp_path_factory.mktemp("box")
    trimesh.creation.box(extents=(2.4, 1.2, 1.0)).apply_translation((0, 0, 0.5)).export(folder / "box.obj")
    return folder


@pytest.fixture(scope="module")
def workshop(box: Path) -> Path:
    """A folder with a mesh, a dataset and an evaluated run."""
    simulate = f"simulate --mesh {box}/box.obj --out {box}/dataset --azimuth 0:360:90 --grazing 30 60"
    assert main([*simulate.split(), "--test-azimuth", "0:360:45", "--pixels", "32", "--masks"]) == 0
    few = "--iterations 4 --points.voxel 0.3 --points.rays-per-pixel 2"
    assert main(f"reconstruct {box}/dataset --out {box}/run {few}".split()) == 0
    assert main(["evaluate", f"{box}/run"]) == 0
    return box


@pytest.fixture
def there(workshop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the workshop."""
    monkeypatch.chdir(workshop)


@pytest.fixture
def run(there: None, tmp_path: Path) -> Path:
    """A copy of its run."""
    return shutil.copytree("run", tmp_path / "run")


@pytest.fixture
def unfinished() -> Callable[[Path], None]:
    """Lets a run's folder say that its training is to go on."""

    def change(run: Path) -> None:
        header = json.loads((run / "config.json").read_text())
        header["config"]["iterations"] = 6000
        (run / "config.json").write_text(json.dumps(header))

    return change
