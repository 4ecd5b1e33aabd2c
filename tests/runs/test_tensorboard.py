"""The log for TensorBoard, read back with TensorBoard's own reader."""

import io
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made import FEW_POINTS, dataset_of
from made_runs import assert_same
from sarsplat import Config, Dataset, ImageGrid, Run, SarsplatError, View, preset, write_dataset
from sarsplat.cli import main
from sarsplat.runs import METHODS, Step, TensorBoard, reconstruct

pytest.importorskip("tensorboard")
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

GRID = ImageGrid(16, 14, (0.3, 0.3), (0.4, 0.4))
SHORT = {"gaussians": 40, "iterations": 12, "checkpoint_every": 6}
CONFIG: Config = replace(preset("quick"), **SHORT, scattering_penalty=0.1, points=FEW_POINTS)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    views = [(View(azimuth, 40.0), "train") for azimuth in range(0, 360, 60)] + [(View(20, 30), "test")]
    images = np.zeros((7, 16, 14), np.float32)
    images[:, 6:10, 5:9] = np.random.default_rng(0).uniform(0.5, 1.5, (7, 4, 4))
    return dataset_of(GRID, views, images)


@pytest.fixture(scope="module")
def plain(dataset: Dataset) -> Run:
    """The training that nobody watches."""
    return reconstruct(dataset, CONFIG, quiet=True)


def read(folder: Path) -> EventAccumulator:
    actual = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    actual.Reload()
    return actual


def steps(actual: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in actual.Scalars(tag)]


def test_curves_and_images(dataset: Dataset, plain: Run, tmp_path: Path) -> None:
    run = reconstruct(dataset, CONFIG, on_step=TensorBoard(tmp_path / "log", dataset), quiet=True)
    assert_same(run.snapshot, plain.snapshot)
    actual = read(tmp_path / "log")
    assert steps(actual, "loss") == list(range(1, 13))
    logged = [event.value for event in actual.Scalars("loss")]
    np.testing.assert_allclose(logged, [line.loss for line in run.history], rtol=1e-6)
    assert [event.value for event in actual.Scalars("Gaussians")] == [len(run.gaussians)] * 12
    assert all(event.value > 0 for event in actual.Scalars("seconds per step"))
    assert (terms := actual.Scalars("terms/scattering penalty"))[0].value == 0 < terms[-1].value  # alike at first
    rates = [event.value for event in actual.Scalars("learning rate/means")]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < rates[0]
    tags = actual.Tags()["images"]
    assert {tag.split(",")[0] for tag in tags} == {"train 000", "train 003", "test 006"}
    rendered = actual.Images("test 006, azimuth 20°, grazing 30°/rendered")
    assert [event.step for event in rendered] == [1, 2, 3, 4, 6, 8, 11, 12]
    (truth,) = actual.Images("train 003, azimuth 180°, grazing 40°/truth")
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(truth.encoded_image_string))
    shown = np.asarray(image.convert("L"))
    assert shown.shape == (16, 14)
    assert (shown[6:10, 5:9] > 200).all()  # within 10 dB of the brightest
    assert shown[0].max() == 0


class Died(Exception):
    """Raised by nothing but `dying`."""


def dying(board: TensorBoard, iteration: int) -> Callable[[Step], None]:
    """The same log, of a training that dies after that step."""

    def look(step: Step) -> None:
        board(step)
        if step.iteration == iteration:
            raise Died

    return look


@pytest.mark.parametrize("inside", [True, False])
def test_resuming_appends(dataset: Dataset, plain: Run, tmp_path: Path, inside: bool) -> None:
    """A training that dies at step 9 is resumed from its checkpoint at step 6; what it logged since is hidden."""
    out = tmp_path / "run"
    log = out / "tensorboard" if inside else tmp_path / "log"
    with pytest.raises(Died):
        reconstruct(dataset, CONFIG, out, on_step=dying(TensorBoard(log, dataset), 9), quiet=True)
    assert steps(read(log), "loss") == list(range(1, 10))  # flushed, though nobody closed it
    (out / "checkpoints" / "00000009.safetensors").unlink()  # as if killed
    resumed = reconstruct(dataset, CONFIG, out, on_step=TensorBoard(log, dataset), resume=True, quiet=True)
    assert steps(read(log), "loss") == list(range(1, 13))
    assert_same(resumed.snapshot, plain.snapshot)


def test_a_run_that_is_overwritten_keeps_its_log_until_the_new_one_is_there(dataset: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "run"

    def once(config: Config, **options: object) -> None:
        reconstruct(dataset, config, out, on_step=TensorBoard(out / "tensorboard", dataset), quiet=True, **options)

    once(CONFIG)
    before = sorted((out / "tensorboard").iterdir())
    board = TensorBoard(out / "tensorboard", dataset)
    with pytest.raises(Died):
        reconstruct(dataset, CONFIG, out, on_step=dying(board, 3), quiet=True, overwrite=True)
    board.close()
    assert sorted((out / "tensorboard").iterdir()) == before
    once(replace(CONFIG, iterations=8), overwrite=True)
    assert steps(read(out / "tensorboard"), "loss") == list(range(1, 9))


def test_other_methods_are_logged_too(dataset: Dataset, tmp_path: Path) -> None:
    method = "sar-nerf-grid"
    settings = replace(METHODS[method].preset("auto", dataset), iterations=3, rays=2, surface_voxels=12)
    reconstruct(dataset, settings, method=method, on_step=TensorBoard(tmp_path, dataset, test_views=0), quiet=True)
    actual = read(tmp_path)
    assert steps(actual, "loss") == [1, 2, 3]
    assert "learning rate/group 0" in actual.Tags()["scalars"]
    assert "Gaussians" not in actual.Tags()["scalars"]
    assert len(actual.Images("train 000, azimuth 0°, grazing 40°/rendered")) == 3


def test_a_killed_process_leaves_its_log(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies on the disk after a step is what is left of a process that is killed there."""
    write_dataset(tmp_path / "data", dataset)
    out, look = tmp_path / "run", TensorBoard.__call__

    def and_copy(board: TensorBoard, step: Step) -> None:
        look(board, step)
        if step.iteration == 9:
            shutil.copytree(out, tmp_path / "left")

    monkeypatch.setattr(TensorBoard, "__call__", and_copy)
    words = ["reconstruct", str(tmp_path / "data"), "--preset", "quick", "--gaussians", "40", "--iterations", "12"]
    assert main([*words, "--checkpoint-every", "6", "--out", str(out), "--tensorboard"]) == 0
    assert steps(read(tmp_path / "left" / "tensorboard"), "loss") == list(range(1, 10))


def test_without_tensorboard(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(SarsplatError, match=r"pip install 'sarsplat\[tensorboard\]'"):
        TensorBoard(tmp_path, dataset)
    write_dataset(tmp_path / "data", dataset)
    assert main(["reconstruct", str(tmp_path / "data"), "--out", str(tmp_path / "run"), "--tensorboard"]) == 2
    assert "sarsplat[tensorboard]" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
