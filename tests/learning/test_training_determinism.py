"""Trainings are the same bit for bit: with any threads, batches and default dtype, run after run, across a kill."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from train_once import config

from made import box_dataset, boxes, dataset_of, small_dataset
from made_runs import assert_equal, assert_same, made_up, trained
from sarsplat import Config, Dataset, ImageGrid, Run, ScatteringLaw, View, preset, reconstruct, simulate_raycast
from sarsplat.data import load_checkpoint, write_dataset
from sarsplat.geometry import RayGrid
from sarsplat.learning import Trainer, batching
from sarsplat.learning.batching import in_groups
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.target import dropped
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info
from sarsplat.learning.strategies.density import DensityControl
from sarsplat.runs.methods import method_named
from sarsplat.settings.sections import Densification

# Eight images have more pixels than torch sums on one thread, 2^15.
GRID = ImageGrid(72, 72, (0.15, 0.15), (0.25, 0.25))
KINDS = ("density", "measured")
_STEPS = 11  # one of them with density control


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    pytest.importorskip("embreex")
    mesh = boxes(((3.0, 2.0, 1.2), (0, 0, 0.6)))
    views = [(View(azimuth, 40.0), "train") for azimuth in range(0, 360, 40)]
    images = np.stack([simulate_raycast(mesh, view, GRID, ScatteringLaw()) for view, _ in views])
    images += 0.02 * np.random.default_rng(0).exponential(size=images.shape).astype(np.float32)  # no two pixels alike
    return write_dataset(tmp_path_factory.mktemp("box") / "dataset", dataset_of(GRID, views, images))


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
        assert_equal(states_of(count), alone)


@pytest.mark.parametrize("changes", [{}, {"scattering": "harmonics", "harmonics_degree": 0}])
def test_threads_do_not_change_the_cost_of_many(dataset: Dataset, changes: dict[str, Any], threads: Any) -> None:
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


def assert_same_files(a: Path, b: Path) -> None:
    for name in ("gaussians.ply", "points.ply"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    checkpoints = sorted(path.name for path in (a / "checkpoints").iterdir())
    assert checkpoints == ["00000050.safetensors", "00000100.safetensors"]
    for name in checkpoints:
        (x, state), (y, other) = (load_checkpoint(run / "checkpoints" / name) for run in (a, b))
        assert_equal(x, y)
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
    assert_same_files(tmp_path / "whole", tmp_path / "killed")


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


# ---- whatever torch makes by default ---------------------------------------------------------------------------------
@pytest.fixture
def doubles() -> Iterator[None]:
    yield
    torch.set_default_dtype(torch.float32)


def of_preset() -> Run:
    return reconstruct(small_dataset(), replace(preset("default"), iterations=12, gaussians=60), quiet=True)


def of_grid() -> Run:
    config = method_named("sar-nerf-grid").settings.from_dict({"iterations": 2}, "the test")
    return reconstruct(small_dataset(), config, method="sar-nerf-grid", quiet=True)


@pytest.mark.parametrize("share", [1e-3, 0.15, 0.4, 0.9])
def test_the_same_are_dropped(share: float, doubles: None) -> None:
    usual = dropped(200_000, share, 3, 7, torch.device("cpu"))
    torch.set_default_dtype(torch.bfloat16)
    assert torch.equal(dropped(200_000, share, 3, 7, torch.device("cpu")), usual)
    assert float(usual.sum()) == pytest.approx(share * len(usual), rel=0.2)


@pytest.mark.filterwarnings("ignore:.*cannot determine the shape", "ignore:.*are constant")
@pytest.mark.parametrize("trained", [of_preset, lambda: made_up("T72"), of_grid], ids=["default", "measured", "grid"])
def test_the_default_of_torch_changes_no_bit(trained, doubles) -> None:
    usual = trained().snapshot.tensors
    torch.set_default_dtype(torch.float64)
    other = trained().snapshot.tensors
    assert {name: tensor.dtype for name, tensor in other.items()} == {n: t.dtype for n, t in usual.items()}
    assert_equal(other, usual)


# ---- views of a step a few at a time ---------------------------------------------------------------------------------
SMALL = ImageGrid(24, 24, (0.3, 0.3), (0.4, 0.4))


@pytest.fixture(scope="module")
def few_pixels(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return box_dataset(tmp_path_factory.mktemp("few"), SMALL)


def in_threes(**changes: object) -> Config:
    return replace(preset("default"), iterations=12, gaussians=200, coarsest=1, views_per_step=3, **changes)


def compared(few_pixels: Dataset, how: Config) -> tuple[torch.Tensor, list[torch.Tensor], Info]:
    trainer = Trainer(few_pixels, how)
    loss, total, rendering = trainer._losses([0, 2, 1], 1, 1)
    total.backward()
    others = trainer._rays, trainer._bounds, torch.Generator()
    info = Info(trainer.model, trainer.images, (0, 2, 1), rendering, 0, *others)
    return loss, [tensor.grad for tensor in trainer.model.parameters.values()], info


def same(one: torch.Tensor, whole: torch.Tensor) -> None:
    torch.testing.assert_close(one.detach(), whole.detach(), rtol=1e-3, atol=1e-5 * float(whole.detach().abs().max()))


@pytest.mark.parametrize("changes", [{}, {"loss": "speckle", "total_power": 0.05}, {"densification": Densification()}])
def test_they_have_the_loss_and_the_gradients_of_all_at_once(few_pixels, monkeypatch, changes):
    loss, gradients, at_once = compared(few_pixels, in_threes(**changes))
    expected = at_once.errors(), at_once.lit_areas()
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    few_loss, few_gradients, few = compared(few_pixels, in_threes(**changes))
    torch.testing.assert_close(few_loss, loss)
    for one, whole in zip((*few_gradients, few.errors(), few.lit_areas()), (*gradients, *expected), strict=True):
        same(one, whole)
    for name in ("images", "cross_sections", "lit_area"):
        same(getattr(few.rendering, name), getattr(at_once.rendering, name))
    slopes, of_whole = few.rendering.plane_gradients, at_once.rendering.plane_gradients
    assert (slopes is not None) == (of_whole is not None) == ("densification" in changes)
    if slopes is not None and of_whole is not None:
        same(slopes, of_whole)


def test_a_training_is_the_same_for_any_number_of_threads_and_where_it_goes_on(few_pixels, monkeypatch, threads):
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)

    def resumed(stop: int) -> Snapshot:
        snapshot = trained(few_pixels, in_threes(), stop).snapshot(0.0)
        threads(3 if torch.get_num_threads() == 1 else 1)
        return trained(few_pixels, in_threes(), 12 - stop, snapshot).snapshot(0.0)

    assert_same(resumed(5), resumed(9))


def test_how_many_follows_from_sizes():
    grid = ImageGrid(2048, 2048, (0.3, 0.3), (0.3, 0.3))
    rays = RayGrid.for_image(grid)

    def groups(count: int, views: int = 5, most: int = 4) -> list[slice]:
        return in_groups(views, most, {"means": torch.empty(count, 3), "law": torch.empty(1, 3)}, grid, rays)

    assert groups(10_000) == [slice(0, 4), slice(4, 5)]
    assert groups(10_000, 3, 3) == [slice(0, 3)]
    assert groups(1_000_000) == [slice(0, 2), slice(2, 4), slice(4, 5)]
    assert groups(20_000_000) == [slice(k, k + 1) for k in range(5)]


def test_a_loss_of_ones_own_sees_all_views_of_a_step(few_pixels, monkeypatch):
    """It need not be a mean over them."""
    monkeypatch.setattr(batching, "_STEP_GIB", 1e-9)
    seen: list[int] = []

    def loss(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        seen.append(len(rendered))
        return (rendered - truth).square().sum().sqrt()

    Trainer(few_pixels, in_threes(), loss=loss).step()
    assert seen == [3, 3]  # black images, and those of the step


def test_sampling_in_pieces_draws_the_same(few_pixels, monkeypatch):
    from sarsplat.gaussians import initialise

    region = initialise.bounded_region(few_pixels.images("train"), few_pixels.select("train").views, SMALL)
    whole = region.sample(1000, torch.Generator().manual_seed(0))
    monkeypatch.setattr(initialise, "_BATCH", 300)
    assert (region.sample(1000, torch.Generator().manual_seed(0)) == whole).all()
