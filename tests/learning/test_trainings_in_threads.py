"""Several trainings in threads of one process, as a sweep does them on a GPU: each learns what it learns alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from emulated_cuda import Emulator
from emulated_recorder import EmulatedRecorder
from test_recorded_steps import CONFIGS

from made_runs import assert_same
from sarsplat import Dataset
from sarsplat.learning import Trainer
from sarsplat.learning.snapshot import Snapshot
from sarsplat.renderer.engines import choice, cuda, on_device

STEPS = 12
TOGETHER = ("default", "quick", "speckled", "measured")


@pytest.fixture(params=["emulated GPU", "CPU"])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """What trains: an emulated GPU, with a queue and recorders for each thread, or the CPU's own engine."""
    if request.param == "CPU":
        yield request.param
        return
    library: Path = request.getfixturevalue("library")
    launcher = Emulator(library)
    emulated = choice.Engine(
        "cpu", lambda *_: partial(cuda.Pass, launcher), takes_bounds=True, recorder=lambda _: EmulatedRecorder(launcher)
    )
    monkeypatch.setitem(choice.ENGINES, "cuda", emulated)
    monkeypatch.setitem(choice.ENGINES, "cpu", replace(choice.ENGINES["cpu"], device_type="none"))
    monkeypatch.setattr(on_device, "queue_of", lambda device: threading.get_ident())
    choice._fitting.cache_clear()
    yield request.param
    choice._fitting.cache_clear()


def learned(name: str, dataset: Dataset, together: threading.Barrier | None) -> tuple[Snapshot, bool]:
    """After some steps, and whether they were recorded; beside others if there is a barrier at which all begin."""
    trainer = Trainer(dataset, replace(CONFIGS[name], seed=len(name)))
    if together is not None:
        together.wait()
    for _ in range(STEPS):
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
