"""Several runs at a time in one process, as on a GPU: the same bits, answers that fit, and no other run is lost."""

import json
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import ModuleType, SimpleNamespace
from typing import Any

import msgspec
import pytest
import torch

from sarsplat import SarsplatError, SarsplatWarning, Trainer, sweep
from sarsplat.executors import Means, executor_local, executor_ray
from sarsplat.executors.executor_local import Worker, serve
from sarsplat.sweeps.cell import Cell, cells_of
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.work import RUN, Row, caught, do, row_of, row_path


@pytest.fixture
def cells(place: Path, plan: dict[str, Any]) -> list[Cell]:
    """Two runs on the CPU, and folders for them in `out`."""
    for name in ("rows", "runs"):
        (place / "out" / name).mkdir(parents=True)
    return cells_of(Plan.from_dict(plan), place)


@pytest.fixture
def endless(place: Path, plan: dict[str, Any], cells: list[Cell]) -> list[Cell]:
    """Two runs that go on until they are stopped."""
    settings = {**plan["settings"], "iterations": 10**6, "checkpoint_every": 10**6}
    return cells_of(Plan.from_dict({**plan, "settings": settings}), place)


@contextmanager
def under_way(crew: Worker, cells: list[Cell], out: Path) -> Iterator[list[Any]]:
    """The answers to come, once all these runs are being done."""
    with ThreadPoolExecutor(len(cells)) as pool:
        asked = [pool.submit(crew.ask, cell) for cell in cells]
        try:
            end = time.monotonic() + 120
            while not all((out / "runs" / f".{cell.address}.sarsplat-new").exists() for cell in cells):
                assert time.monotonic() < end
                time.sleep(0.02)
            yield asked
        finally:
            crew.kill()
    crew.close()


def test_a_process_that_ends_loses_its_runs_and_the_next_one_answers_with_the_same_bits(
    place, plan, cells, endless, results
):
    out = place / "out"
    crew = Worker(Cell.work, out, again=False, at_a_time=2)
    with under_way(crew, endless, out) as asked:
        crew._process.stdin.close()  # as when the parent is killed
        for cell, answer in zip(endless, asked, strict=True):
            row = answer.result(timeout=60)
            assert (row.address, row.state, row.passing) == (cell.address, "failed", True)
            assert row.reason.startswith("its process ended with code 0; ")
            assert row_of(cell, out) is None  # it is tried again
            row_path(cell, out).unlink()
        with ThreadPoolExecutor(2) as pool:
            rows = [*pool.map(crew.ask, cells)]
    assert [(row.address, row.state) for row in rows] == [(cell.address, "finished") for cell in cells]
    sweep(plan, place / "alone", executor="here", quiet=True)
    assert results(out) == results(place / "alone")


@pytest.mark.slow
def test_runs_that_were_lost_go_on_from_their_checkpoints(place, plan, cells, results):
    plan["settings"] |= {"iterations": 1500, "checkpoint_every": 100}
    longer, out = cells_of(Plan.from_dict(plan), place), place / "out"
    crew = Worker(Cell.work, out, again=False, at_a_time=2)
    with under_way(crew, longer, out) as asked:
        end = time.monotonic() + 120
        while not all((out / "runs" / cell.address / "checkpoints").exists() for cell in longer):
            assert time.monotonic() < end
            time.sleep(0.02)
        os.kill(crew._process.pid, signal.SIGKILL)
        assert [answer.result(timeout=60).state for answer in asked] == ["failed", "failed"]
        with ThreadPoolExecutor(2) as pool:
            assert [row.state for row in pool.map(crew.ask, longer)] == ["finished", "finished"]
    sweep(plan, place / "alone", executor="here", quiet=True)
    assert results(out) == results(place / "alone")


def test_a_sweep_that_is_ended_ends_all_that_is_under_way(place, endless):
    out = place / "out"
    crew = Worker(Cell.work, out, again=False, at_a_time=2)
    with under_way(crew, endless, out) as asked:
        crew.kill()
        assert [answer.result(timeout=60) for answer in asked] == [None, None]
        assert crew.ask(endless[0]) is None  # and nothing begins any more
    assert not [*(out / "rows").glob("*.json")]


@pytest.mark.slow
def test_runs_in_threads_on_an_emulated_gpu_have_the_same_bits(place, plan, cells, results, library, monkeypatch):
    from emulated_cuda import Emulator, on_emulated_gpu

    step, recorded = Trainer.step, []
    monkeypatch.setattr(Trainer, "step", lambda self: (step(self), recorded.append(self.records))[0])
    with on_emulated_gpu(Emulator(library)):
        sweep(plan, place / "alone", executor="here", quiet=True)
        with ThreadPoolExecutor(len(cells)) as pool:
            rows = [*pool.map(partial(do, out=place / "out"), cells)]
    assert [row.state for row in rows] == ["finished"] * 2
    assert all(recorded)
    assert results(place / "out") == results(place / "alone")


# ---- who does what --------------------------------------------------------------------------------------------------
@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, dict[str, str], list[str]]]:
    """Workers that only note what they are asked: how many at a time, in which environment, and devices."""
    made: list[tuple[int, dict[str, str], list[str]]] = []

    class Noting:
        def __init__(self, work: str, out: Path, again: bool, at_a_time: int = 1, environment: Any = None) -> None:
            self.asked: list[str] = []
            made.append((at_a_time, environment or {}, self.asked))

        def ask(self, cell: Cell) -> Row:
            self.asked.append(cell.device)
            return Row(cell.address, cell.recipe, cell.code, cell.scoring, "finished")

        def kill(self) -> None:
            pass

        close = kill

    monkeypatch.setattr(executor_local, "Worker", Noting)
    monkeypatch.setattr(executor_local, "_processors", lambda: 6)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return made


def done(plan: dict[str, Any], place: Path, means: Means) -> None:
    cells = cells_of(Plan.from_dict(plan), place)
    assert {cell.address for cell, _ in executor_local.run(cells, place, means)} == {cell.address for cell in cells}


def test_a_gpu_has_one_process_and_the_cpu_one_for_each_run(place, plan, made, monkeypatch):
    parts = [{"name": device, "device": device} for device in ("cpu", "cuda")]
    plan |= {"seeds": [*range(12)], "parts": parts}
    done(plan, place, Means(processes=3, per_device=5))
    assert [at_a_time for at_a_time, *_ in made] == [1, 1, 1, 5, 5]
    assert [environment for _, environment, _ in made[3:]] == [{"CUDA_VISIBLE_DEVICES": name} for name in "01"]
    assert {device for *_, asked in made[:3] for device in asked} == {"cpu"}
    assert {device for *_, asked in made[3:] for device in asked} == {"cuda"}
    assert sum(len(asked) for *_, asked in made) == 24
    made.clear()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-5,MIG-7")
    done(plan | {"seeds": [0, 1], "parts": parts[1:]}, place, Means(per_device=5))
    assert [each[:2] for each in made] == [(1, {"CUDA_VISIBLE_DEVICES": name}) for name in ("GPU-5", "MIG-7")]


@pytest.mark.parametrize(("count", "processors", "expected"), [(2, 6, 3), (1, 16, 4), (1, 1, 1), (0, 16, 4)])
def test_how_many_share_a_gpu_unasked(place, plan, made, monkeypatch, count, processors, expected):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(executor_local, "_processors", lambda: processors)
    done(plan | {"seeds": [*range(20)], "device": "cuda"}, place, Means())
    assert [at_a_time for at_a_time, *_ in made] == [expected] * max(1, count)
    assert count > 1 or made[0][1] == {}


def test_per_device_is_for_plans_with_a_gpu(place, plan):
    with pytest.raises(SarsplatError, match="per_device is 2, but no run of the plan is on a GPU; leave it out, or"):
        sweep(plan, place / "out", means=Means(per_device=2), quiet=True)
    with pytest.raises(SarsplatError, match="per_device is 0; give a finite number from 1"):
        Means(per_device=0)
    with pytest.raises(SarsplatError, match="device is 'tpu'; it must be"):
        sweep(plan, place / "out", device="tpu", quiet=True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_another_device_than_the_plans_is_that_of_all_its_parts(place, plan):
    plan |= {"device": "cpu", "parts": [{"name": "a"}, {"name": "b", "device": "cpu", "seeds": [5]}]}
    found = sweep(plan, place / "out", device="cuda", executor="here", means=Means(per_device=2), quiet=True)
    assert [one.cell.device for one in found.results] == ["cuda"] * 3
    reasons = [one.reason for one in found.failed]
    assert len(reasons) == 3
    assert all("CUDA engine needs a torch built for CUDA" in reason or "GPU" in reason for reason in reasons)


@pytest.mark.parametrize(("device", "gpus", "asked"), [("cuda", 0.25, 0.25), ("cuda", None, 1.0), ("cpu", None, 0.0)])
def test_ray_is_asked_for_a_part_of_a_gpu(place, plan, monkeypatch, device, gpus, asked):
    """By a stand-in for Ray, which does everything in this process."""
    options: list[dict[str, Any]] = []

    def remote(do: Callable[..., Any]) -> Any:
        return SimpleNamespace(options=lambda **given: options.append(given) or SimpleNamespace(remote=do))

    ray: Any = ModuleType("ray")
    ray.is_initialized, ray.cluster_resources, ray.remote = lambda: True, dict, remote
    ray.wait, ray.get = lambda tasks, num_returns: (tasks[:1], tasks[1:]), json.loads
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(executor_ray, "_do", lambda work, cell, *_: json.dumps(msgspec.to_builtins(finished(cell))))
    cells = cells_of(Plan.from_dict(plan | {"device": device}), place)
    rows = [row for _, row in executor_ray.run(cells, place, Means(gpus=gpus))]
    assert {row.address for row in rows} == {cell.address for cell in cells}
    assert {given["num_gpus"] for given in options} == {asked}


def finished(cell: dict[str, Any]) -> Row:
    done = msgspec.convert(cell, Cell)
    return Row(done.address, done.recipe, done.code, done.scoring, "finished")


# ---- the process ----------------------------------------------------------------------------------------------------
class Ended(BaseException):
    """In place of the end of the process."""


@pytest.fixture
def served(cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Any]]:
    """Threads of a process with a GPU that notes who used which stream; `do` is replaced."""

    def run(do: Callable[..., Any], threads: int, synchronize: Callable[[], None]) -> list[Any]:
        asked: SimpleQueue[bytes] = SimpleQueue()
        said: list[Any] = []

        def ended(code: int) -> None:
            raise Ended(code)

        @contextmanager
        def on(stream: Any) -> Iterator[None]:
            current.stream = stream
            yield
            current.stream = None

        current = threading.local()
        kind = replace(RUN, do=lambda cell, out, again: do(cell, current.stream))
        monkeypatch.setattr(executor_local.torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(executor_local.torch.cuda, "Stream", lambda: SimpleNamespace(synchronize=synchronize))
        monkeypatch.setattr(executor_local.torch.cuda, "stream", on)
        monkeypatch.setattr(executor_local.os, "_exit", ended)
        for cell in cells:
            asked.put(msgspec.json.encode(on_gpu(cell)))
        for _ in range(threads):
            asked.put(b"{}")  # ends a thread

        def one() -> None:
            with suppress(Ended, msgspec.ValidationError):
                serve(kind, asked, lambda job, _: said.append(job), Path(), False)

        with ThreadPoolExecutor(threads) as pool:
            for _ in range(threads):
                pool.submit(one)
        return said

    return run


def on_gpu(cell: Cell) -> Cell:
    return msgspec.structs.replace(cell, device="cuda")


def test_every_thread_has_a_stream_of_its_own(cells, served):
    all_there, streams = threading.Barrier(len(cells), timeout=60), set()

    def do(cell: Cell, stream: Any) -> None:
        all_there.wait()
        streams.add(id(stream))

    said = served(do, len(cells), lambda: None)
    assert len(streams) == len(cells)
    assert {job.address for job in said} == {on_gpu(cell).address for cell in cells}


def test_a_process_whose_gpu_has_failed_answers_and_ends(cells, served):
    def synchronize() -> None:
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    assert len(served(lambda cell, stream: None, 1, synchronize)) == 1
    for code, reason in (
        (executor_local._BROKEN_GPU, "the GPU failed in another run of its process"),
        (-signal.SIGKILL, "its process was ended by SIGKILL, as when memory runs out: give fewer `processes`"),
    ):
        assert executor_local._reason(cells[0], code, RUN.go_on) == f"{reason}; start the sweep again to continue it"


def test_warnings_are_told_apart_by_thread():
    count = 4
    all_there = threading.Barrier(count, timeout=60)

    def warned(k: int) -> list[str]:
        with caught() as mine:
            all_there.wait()
            for _ in range(2):
                warnings.warn(f"warning {k}", SarsplatWarning, stacklevel=1)
            all_there.wait()
            if k == 0:
                other = threading.Thread(target=warnings.warn, args=("a library's", SarsplatWarning))
                other.start()
                other.join()
            all_there.wait()
        return mine

    before = warnings.filters[:], warnings.showwarning
    with ThreadPoolExecutor(count) as pool:
        found = [*pool.map(warned, range(count))]
    assert (warnings.filters, warnings.showwarning) == before
    assert found == [[f"warning {k}", f"warning {k}", "a library's"] for k in range(count)]
