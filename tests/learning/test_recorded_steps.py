"""Steps that a GPU makes by itself: the same bits as launch by launch, for as long as what it was told suffices."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from emulated_cuda import EmulatedRecorder, Emulator, on_emulated_gpu
from torch import Tensor

from made import box_dataset, hill
from made_runs import assert_same
from sarsplat import Config, Dataset, ImageGrid, SarsplatWarning, preset
from sarsplat.learning import Trainer, scene_frame
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies.growth import Relocating
from sarsplat.renderer.engines import bounds, cuda_device
from sarsplat.settings.sections import Bounce, Densification, FlatGround, Relocation, Smoothing, Surroundings

STEPS, MORE = 16, 20  # more where more is recorded anew
SELDOM = Surroundings(texture_rounds=2, azimuth_rounds=2)
DENSITY = Densification(3, 12, 5, gradient=1e-4, split_above=0.16, min_scattering=0.01, max_gaussians=300)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A box in few pixels: an emulated GPU takes its time."""
    return box_dataset(tmp_path_factory.mktemp("few-pixels"), ImageGrid(16, 16, (0.6, 0.6), (0.9, 0.9)))


def small(name: str, **changes: Any) -> Config:
    few = {"iterations": STEPS, "gaussians": 50, "harmonics_every": 7, "views_per_step": 2}
    return replace(preset(name), **few | changes)


CONFIGS = {
    "default": small("default"),
    "quick": small("quick"),
    "speckled": small("speckled"),
    "paper": small("paper", views_per_step=1),
    "measured": small("measured", iterations=MORE, harmonics_every=14, surroundings=SELDOM),
    "azimuths": small("measured", iterations=MORE, harmonics_every=MORE, views_per_step=3, surroundings=SELDOM),
    "ground": small("default", ground=FlatGround()),
    "ground of one kind": small("quick", ground=FlatGround(pitch=0.0), views_per_step=3),
    "terrain": small("default", ground=FlatGround(), coarsest=1),
    "density": small("paper", iterations=MORE, harmonics_every=MORE, densification=DENSITY),
    "levels": small(
        "default", harmonics_every=STEPS, coarsest=2, relocation=Relocation(rounds=8), smoothing=Smoothing(rounds=8)
    ),
}


@pytest.fixture
def recorder(library: Path) -> Iterator[EmulatedRecorder]:
    """An emulated GPU that records steps."""
    recorder = EmulatedRecorder(Emulator(library))
    with on_emulated_gpu(recorder.launcher, lambda _: recorder):
        yield recorder


@pytest.mark.parametrize("name", CONFIGS)
def test_replayed_steps(
    name: str, dataset: Dataset, recorder: EmulatedRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "levels":  # which a scene so small has not
        monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 2)
    if name == "azimuths":
        uncertain = (replace(entry, azimuth_std_deg=2.0) for entry in dataset.entries)
        dataset = replace(dataset, entries=tuple(uncertain))
    if name == "terrain":
        dataset = replace(dataset, ground=True, terrain=hill(-0.5, width_m=4.0))
    by_itself, launched = (Trainer(dataset, CONFIGS[name]) for _ in range(2))
    launched.records, records = False, 0
    kept: list[tuple[dict[str, Tensor], dict[str, float]]] = []
    steps = CONFIGS[name].iterations
    for step in range(steps):
        losses = [trainer.step() for trainer in (by_itself, launched)]
        assert torch.equal(*losses), step
        if recorder.records > records:
            records = recorder.records
            for other in range(300):  # which drive out what was sent; the record keeps what it reads
                cuda_device._sent(other.to_bytes(2, "big"), torch.device("cpu"))
        kept.append((by_itself.terms, {name: float(term) for name, term in launched.terms.items()}))
    for terms, were in kept:  # which no later step has overwritten
        assert {name: float(term) for name, term in terms.items()} == were
    assert by_itself.records
    assert recorder.replays > steps // 2
    assert_same(by_itself.snapshot(0.0), launched.snapshot(0.0))


@pytest.mark.parametrize("name", ["ground", "terrain"])
@pytest.mark.parametrize("views", [2, 12])
def test_large_scenes_are_not_recorded(
    name: str, views: int, dataset: Dataset, recorder: EmulatedRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where rays stand is read back there, and is not known of views that only the device knows."""
    monkeypatch.setattr(bounds, "_MAX_ALLOCATED", 100)
    if name == "terrain":
        dataset = replace(dataset, ground=True, terrain=hill(-0.5, width_m=4.0))
    asked, launched = (Trainer(dataset, replace(CONFIGS[name], views_per_step=views)) for _ in range(2))
    launched.records = False
    for _ in range(2):
        assert torch.equal(asked.step(), launched.step())
    assert not asked.records


def test_second_bounces_are_not_recorded(
    dataset: Dataset, recorder: EmulatedRecorder, caplog: pytest.LogCaptureFixture
) -> None:
    """And by the same engine without limits, beyond which mirror images lie."""
    caplog.set_level("INFO")
    asked, launched = (Trainer(dataset, replace(CONFIGS["ground"], bounce=Bounce())) for _ in range(2))
    launched.records = False
    for _ in range(3):
        assert torch.equal(asked.step(), launched.step())
    assert not asked.records
    assert "cannot be recorded: has an echo from beyond its bounds" in caplog.text
    asked.check()


def test_strategies_that_act_before_gradients_are_not_recorded(dataset: Dataset, recorder: EmulatedRecorder) -> None:
    class Watching(Relocating):
        name, seen = "watching", 0

        def step_pre_backward(self, *_: Any) -> None:
            self.seen += 1

    trainer = Trainer(dataset, CONFIGS["default"], strategies=[watching := Watching(CONFIGS["default"], dataset)])
    trainer.step()
    assert (trainer.records, watching.seen) == (False, 1)


def test_a_failed_record_loses_nothing(
    dataset: Dataset, recorder: EmulatedRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_itself, launched = (Trainer(dataset, CONFIGS["quick"]) for _ in range(2))
    launched.records = False

    def refused(program: object) -> None:
        raise RuntimeError("operation failed due to a previous error during capture")

    monkeypatch.setattr(recorder, "record", refused)
    with pytest.warns(SarsplatWarning, match="CUDA graphs are off, because .* error during capture") as said:
        for _ in range(5):
            assert torch.equal(by_itself.step(), launched.step())
    assert len(said) == 1
    assert_same(by_itself.snapshot(0.0), launched.snapshot(0.0))


# ---- several trainings in threads of one process, as a sweep does them on a GPU --------------------------------------
TOGETHER = ("default", "quick", "speckled", "measured")


@pytest.fixture(params=[pytest.param("emulated GPU", marks=pytest.mark.slow), "CPU"])
def engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """What trains: an emulated GPU, with a queue and recorders for each thread, or the CPU's own engine."""
    gpu = request.param == "emulated GPU"
    with on_emulated_gpu(Emulator(request.getfixturevalue("library"))) if gpu else nullcontext():
        yield request.param


def learned(name: str, dataset: Dataset, together: threading.Barrier | None) -> tuple[Snapshot, bool]:
    """After some steps, and whether they were recorded; beside others if there is a barrier at which all begin."""
    trainer = Trainer(dataset, replace(CONFIGS[name], seed=len(name)))
    if together is not None:
        together.wait()
    for _ in range(12):
        trainer.step()
    return trainer.snapshot(0.0), trainer.records


def test_trainings_at_a_time_learn_what_each_learns_alone(dataset: Dataset, engine: str) -> None:
    alone = {name: learned(name, dataset, None) for name in TOGETHER}
    all_there = threading.Barrier(len(TOGETHER), timeout=120)
    with ThreadPoolExecutor(len(TOGETHER)) as pool:
        asked = {name: pool.submit(learned, name, dataset, all_there) for name in TOGETHER}
        together = {name: future.result() for name, future in asked.items()}
    for name in TOGETHER:
        (mine, recorded), (theirs, also) = together[name], alone[name]
        assert recorded == also, name
        assert recorded == (engine != "CPU") or name == "measured"
        assert_same(mine, theirs)
