"""A plan whose runs take a moment: images without a surface, few Gaussians, no reports."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from made import box_dataset
from sarsplat import ImageGrid, write_dataset
from sarsplat.data.files import read_json
from sarsplat.executors import EXECUTORS, Means
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import Row, do


def here(cells: Sequence[Cell], out: Path, means: Means) -> Iterator[tuple[Cell, Row | None]]:
    """An executor that does one run after the other in this process."""
    for cell in cells:
        yield cell, do(cell, out, means.again)


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweeps")
    made = box_dataset(folder, ImageGrid(24, 24, (0.3, 0.3), (0.4, 0.4)))
    write_dataset(folder / "data" / "box", replace(made, truth_mesh=None))
    return folder / "data" / "box"


@pytest.fixture
def place(_made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: it holds the dataset data/box."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "box").symlink_to(_made)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(EXECUTORS._entries, "here", None)
    monkeypatch.setitem(EXECUTORS._loaded, "here", here)
    return tmp_path


@pytest.fixture
def plan() -> dict[str, Any]:
    """Two runs."""
    settings = {"iterations": 4, "gaussians": 100, "checkpoint_every": 2, "points.voxel": 0.5}
    return {
        "datasets": ["data/*"],
        "preset": "quick",
        "seeds": [0, 1],
        "reports": False,
        "settings": {**settings, "points.rays_per_pixel": 2},
    }


@pytest.fixture
def untrained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs are finished as soon as they begin."""
    monkeypatch.setattr("sarsplat.sweeps.work._train_and_score", lambda *_: None)


@pytest.fixture
def plan_file(place: Path, plan: dict[str, Any]) -> None:
    """The plan as `plan.toml`."""
    settings = [f'"{name}" = {json.dumps(value)}' for name, value in plan["settings"].items()]
    keys = [f"{name} = {json.dumps(value)}" for name, value in plan.items() if name != "settings"]
    (place / "plan.toml").write_text("\n".join([*keys, "[settings]", *settings]))


@pytest.fixture
def results() -> Callable[[Path], dict[str, Any]]:
    """What a sweep has made that must not depend on who did it, bit for bit, by address."""

    def of(out: Path) -> dict[str, Any]:
        found = {}
        for path in (out / "rows").glob("*.json"):
            row, run = read_json(path, Row), out / "runs" / path.stem
            row.scores.pop("time_s")
            files = ((run / name).read_bytes() for name in ("gaussians.ply", "points.ply"))
            found[path.stem] = (row.state, row.scores, *files)
        return found

    return of
