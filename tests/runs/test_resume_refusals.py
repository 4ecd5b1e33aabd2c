"""A run goes on only with what it was started with: another dataset, other settings or another version are refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from made import dataset_of
from sarsplat import Dataset, ImageGrid, Run, SarsplatError, View, preset, read_dataset, reconstruct
from sarsplat.data import load_checkpoint, save_checkpoint, write_dataset, write_tiff
from sarsplat.learning import scene_frame
from sarsplat.settings import Config
from sarsplat.settings.sections import Densification, PointExtraction, Rates, Smoothing

CONFIG = replace(preset("default"), iterations=2, gaussians=50, checkpoint_every=1)


def make_dataset(path: Path, *, spacing: float = 0.3, azimuth: float = 0.0, seed: int = 0) -> Dataset:
    images = np.zeros((3, 16, 16), np.float32)
    images[:, 6:10, 6:10] = np.random.default_rng(seed).uniform(0.5, 1, size=(3, 4, 4))
    views = [(View(azimuth + 120.0 * k, 40.0), "train") for k in range(3)]
    grid = ImageGrid(16, 16, (spacing, spacing), (0.4, 0.4))
    return write_dataset(path, dataset_of(grid, views, images))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dataset(tmp_path_factory.mktemp("made") / "dataset")


@pytest.fixture(scope="module")
def done(dataset: Dataset) -> Run:
    return reconstruct(dataset, CONFIG, dataset.path.with_name("run"))


@pytest.fixture
def begun(done: Run, tmp_path: Path) -> Path:
    """A run with one step to go."""
    shutil.copytree(done.folder, tmp_path / "run")
    Run.load(tmp_path / "run").store.checkpoint_path.unlink()
    return tmp_path / "run"


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(begun: Path, dataset: Dataset, config: Config, message: str) -> None:
    before = content(begun)
    with pytest.raises(SarsplatError, match=message):
        reconstruct(dataset, config, begun, resume=True)
    assert content(begun) == before


def test_one_of_before_there_was_smoothing(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its settings do not say that it has none, and it goes on without; nor does it say how often it has grown."""
    monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 2)
    unsmoothed = replace(CONFIG, coarsest=2, smoothing=Smoothing(rounds=0))
    whole = reconstruct(dataset, unsmoothed, tmp_path / "run")
    tensors, _ = load_checkpoint(whole.store.checkpoint_path)
    assert "strategy/relocation" in tensors and "strategy/smoothing" not in tensors
    whole.store.checkpoint_path.unlink()
    newest = whole.store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    del tensors["strategy/growth/times"]
    save_checkpoint(newest, tensors, state)
    header = json.loads((tmp_path / "run" / "config.json").read_text())
    del header["config"]["smoothing"]
    (tmp_path / "run" / "config.json").write_text(json.dumps(header))
    refused(tmp_path / "run", dataset, replace(CONFIG, coarsest=2), r"started with smoothing\.rounds 0, not 40")
    again = reconstruct(dataset, Run.load(tmp_path / "run").config, tmp_path / "run", resume=True)
    assert again.config == unsmoothed
    assert torch.equal(again.gaussians.means, whole.gaussians.means)


@pytest.mark.parametrize("change", [{"spacing": 0.31}, {"azimuth": 1e-6}, {"seed": 1}])
def test_another_dataset(begun: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    refused(begun, make_dataset(tmp_path / "other", **change), CONFIG, "started with another dataset")


def test_a_dataset_that_was_changed_in_place(begun: Path, dataset: Dataset, tmp_path: Path) -> None:
    image = dataset.images("train")[1].copy()
    image[0, 0] = 1e-30
    changed = shutil.copytree(dataset.path, tmp_path / "dataset")
    write_tiff(changed / "images/001.tif", image, "changed")
    refused(begun, read_dataset(changed), CONFIG, "started with another dataset")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "started with seed 0, not 1; resume it with the same settings"),
        ({"p_min": 0.031}, "started with p_min 0.03, not 0.031"),
        ({"preset": "mine"}, "started with preset 'default', not 'mine'"),
        ({"rates": Rates(means=0.1)}, r"started with rates\.means 0.15, not 0.1"),
        ({"densification": Densification()}, "started with densification None, not "),
        ({"iterations": 3, "seed": 1}, "started with seed 0, not 1"),
    ],
)
def test_other_settings(begun: Path, dataset: Dataset, change: dict[str, Any], message: str) -> None:
    refused(begun, dataset, replace(CONFIG, **change), message)


def test_fewer_iterations_than_are_done(dataset: Dataset, done: Run) -> None:
    refused(done.folder, dataset, replace(CONFIG, iterations=1), "has already done 2 iterations, more than 1")


@pytest.mark.parametrize("steps", [1, 2])
def test_more_iterations_extend_a_run(begun: Path, dataset: Dataset, steps: int) -> None:
    if steps == 2:
        reconstruct(dataset, CONFIG, begun, resume=True)
    run = reconstruct(dataset, replace(CONFIG, iterations=4, checkpoint_every=3), begun, resume=True)
    assert run.iteration == 4
    assert (Run.load(begun).config.iterations, Run.load(begun).config.checkpoint_every) == (4, 3)
    assert [line.iteration for line in run.history] == [1, 2, 3, 4]


def test_points_are_extracted_anew(dataset: Dataset, done: Run, tmp_path: Path) -> None:
    shutil.copytree(done.folder, tmp_path / "run")
    (tmp_path / "run" / "metrics.json").write_text("{}")
    everything = PointExtraction(method="centres", optical_depth=0.0, voxel=1e-6, min_height=-1e6)
    again = reconstruct(dataset, replace(CONFIG, points=everything), tmp_path / "run", resume=True)
    assert again.iteration == done.iteration
    assert len(Run.load(tmp_path / "run").points) == len(again.gaussians)
    assert not (tmp_path / "run" / "metrics.json").exists()  # it was of other points


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": 5}, "schema_version is 5 but this program reads 4"),
        ({"schema_version": 3}, "was written by an older version"),
        ({"config": CONFIG.as_dict() | {"warmth": 1}}, "config.json: the setting 'warmth' is unknown"),
    ],
)
def test_another_version(begun: Path, dataset: Dataset, change: dict[str, Any], message: str) -> None:
    header = json.loads((begun / "config.json").read_text())
    (begun / "config.json").write_text(json.dumps(header | change))
    refused(begun, dataset, CONFIG, message)


@pytest.mark.parametrize("change", [{"model/optical_depth": None}, {"model/means": torch.empty(0, 3)}])
def test_a_checkpoint_of_another_version(begun: Path, dataset: Dataset, change: dict[str, Any]) -> None:
    newest = Run.load(begun).store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    save_checkpoint(newest, {name: t for name, t in (tensors | change).items() if t is not None}, state)
    for iterations in (2, 4):
        refused(begun, dataset, replace(CONFIG, iterations=iterations), "does not match this version")


def test_a_checkpoint_of_bistatic_views(begun: Path) -> None:
    newest = Run.load(begun).store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    views = [{"azimuth_deg": 1.0, "grazing_deg": 30.0, "apart_deg": 20.0}]
    save_checkpoint(newest, tensors, {**state, "views": views})
    with pytest.raises(SarsplatError, match="bistatic views, which are not supported"):
        Run.load(begun).time_s  # noqa: B018


def test_a_history_that_is_too_long(begun: Path) -> None:
    line = {"iteration": 1, "seconds": 0.5, "loss": 0.25, "gaussians": 50}
    (begun / "metrics.jsonl").write_text((json.dumps(line) + "\n") * 70_000)
    with pytest.raises(SarsplatError, match=r"metrics\.jsonl is longer than 4194304 bytes"):
        _ = Run.load(begun).history


def test_a_run_that_is_not_there(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(SarsplatError, match="does not exist"):
        reconstruct(dataset, CONFIG, tmp_path / "nowhere", resume=True)
    shutil.copytree(dataset.path, tmp_path / "a dataset")
    with pytest.raises(SarsplatError, match="is a dataset, not a run"):
        reconstruct(dataset, CONFIG, tmp_path / "a dataset", resume=True)
