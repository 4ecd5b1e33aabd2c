"""Whole trainings are the same bit for bit: on any number of threads, run after run, and across a kill."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from train_once import config

from made import dataset_of
from made_runs import trained
from sarsplat import Dataset, ImageGrid, Run, ScatteringLaw, View, preset, simulate_raycast
from sarsplat.data import load_checkpoint, write_dataset
from sarsplat.learning import Trainer
from sarsplat.learning.model import SceneModel
from sarsplat.learning.strategies.density import DensityControl

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

# Eight images have more pixels than torch sums on one thread, 2^15.
GRID = ImageGrid(72, 72, (0.15, 0.15), (0.25, 0.25))
KINDS = ("density", "measured")
_STEPS = 11  # one of them with density control


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    mesh = trimesh.creation.box((3.0, 2.0, 1.2))
    mesh.apply_translation([0, 0, 0.6])
    views = [(View(azimuth, 40.0), "train") for azimuth in range(0, 360, 40)]
    images = np.stack([simulate_raycast(mesh, view, GRID, ScatteringLaw()) for view, _ in views])
    images += 0.02 * np.random.default_rng(0).exponential(size=images.shape).astype(np.float32)  # no two pixels alike
    path = tmp_path_factory.mktemp("box") / "dataset"
    return write_dataset(path, dataset_of(GRID, views, images))


@pytest.mark.parametrize("kind", KINDS)
def test_threads_change_nothing(dataset: Dataset, kind: str, threads: Any) -> None:
    def states_of(count: int) -> dict[str, torch.Tensor]:
        threads(count)
        trainer, states = Trainer(dataset, config(kind)), {}
        for step in range(_STEPS):
            trainer.step()
            states |= {f"{step}/{name}": tensor.clone() for name, tensor in trainer.snapshot(0.0).tensors.items()}
        return states

    alone = states_of(1)
    for count in (2, 3):
        states = states_of(count)
        assert states.keys() == alone.keys()
        assert [name for name in alone if not torch.equal(states[name], alone[name])] == []


@pytest.mark.parametrize("changes", [{}, {"scattering": "harmonics", "harmonics_degree": 0}])
def test_threads_do_not_change_what_many_gaussians_cost(
    dataset: Dataset, changes: dict[str, Any], threads: Any
) -> None:
    """More of them than torch sums on one thread, 2^15 numbers."""
    generator, actual = torch.Generator().manual_seed(0), []
    model = SceneModel.initial(replace(preset("default"), gaussians=40_000, **changes), dataset, generator)
    scattering = model.parameters["scattering"]
    with torch.no_grad():
        scattering += torch.randn(scattering.shape, generator=generator)
    for count in (1, 2, 3):
        threads(count)
        spread = model.penalties()["scattering penalty"]
        actual.append((spread.item(), torch.autograd.grad(spread, scattering)[0]))
    assert len({spread for spread, _ in actual}) == 1
    assert all(torch.equal(gradient, actual[0][1]) for _, gradient in actual[1:])


def train(dataset: Dataset, out: Path, threads: int, kind: str, kill_at: str = "") -> int:
    script = Path(__file__).with_name("train_once.py")
    words = [sys.executable, str(script), str(dataset.path), str(out), str(threads), kind, kill_at]
    return subprocess.run(words, check=False, stdout=subprocess.DEVNULL).returncode


def assert_same(a: Path, b: Path) -> None:
    for name in ("gaussians.ply", "points.ply"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    checkpoints = sorted(path.name for path in (a / "checkpoints").iterdir())
    assert checkpoints == ["00000050.safetensors", "00000100.safetensors"]
    for name in checkpoints:
        (x, state), (y, other) = (load_checkpoint(run / "checkpoints" / name) for run in (a, b))
        assert x.keys() == y.keys()
        assert [key for key in x if not torch.equal(x[key], y[key])] == []
        assert {**state, "seconds": 0} == {**other, "seconds": 0}
    logs = [[msgspec.structs.replace(line, seconds=0) for line in Run.load(run).history] for run in (a, b)]
    assert len(logs[0]) == 100
    assert logs[0] == logs[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_killed_and_resumed_on_other_threads_is_the_same(dataset: Dataset, tmp_path: Path, kind: str) -> None:
    assert train(dataset, tmp_path / "whole", 1, kind) == 0
    assert train(dataset, tmp_path / "killed", 3, kind, "50") == -signal.SIGKILL
    assert not (tmp_path / "killed" / "points.ply").exists()
    assert train(dataset, tmp_path / "killed", 2, kind, "13") == -signal.SIGKILL  # between checkpoints
    assert train(dataset, tmp_path / "killed", 2, kind) == 0
    assert_same(tmp_path / "whole", tmp_path / "killed")


def test_density_control_does_all_it_can_in_that_training(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the test above shows little."""
    decide, counts = DensityControl.decide, {"clone": 0, "split": 0, "prune": 0}

    def watched(self: DensityControl, *args: Any) -> Any:
        decided = decide(self, *args)
        for name, rows in zip(("prune", "clone", "split"), decided, strict=True):
            counts[name] += int(rows.sum())
        return decided

    monkeypatch.setattr(DensityControl, "decide", watched)
    trained(dataset, config("density"), 21)
    assert min(counts.values()) >= 10, counts
