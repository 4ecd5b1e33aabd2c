"""Several runs at a time in one process, as on a GPU: the same bits, answers that fit, and no other run is lost."""

import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
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
from sarsplat.sweeps.work import RUN, caught, do, row_of, row_path


@pytest.fixture
def cells(place: Path, plan: dict[str, Any]) -> list[Cell]:
    """Two runs on the CPU, and folders for them in `out`."""
    for name in ("rows", "runs"):
        (place / "out" / name).mkdir(parents=True)
    return cells_of(Plan.from_dict(plan), place)


def test_lost_runs_are_done_by_the_next_process_and_stopped_ones_by_none(place, plan, cells, results):
    """Two at a time in a process, which ends by itself, as when its parent is killed; the next one is killed."""
    out, endless = place / "out", {**plan["settings"], "iterations": 10**6, "checkpoint_every": 10**6}
    stopped = cells_of(Plan.from_dict({**plan, "settings": endless}), place)
    folders = [out / "runs" / f".{cell.address}.sarsplat-new" for cell in stopped]
    crew = Worker(Cell.work, out, again=False, at_a_time=2)
    with ThreadPoolExecutor(2) as pool, ExitStack() as stack:
        stack.callback(crew.kill)

        def under_way() -> list[Future[Any]]:
            asked, end = [pool.submit(crew.ask, cell) for cell in stopped], time.monotonic() + 120
            while not all(folder.exists() for folder in folders):
                assert time.monotonic() < end
                time.sleep(0.02)
            return asked

        asked = under_way()
        crew._process.stdin.close()
        for cell, folder, answer in zip(stopped, folders, asked, strict=True):
            row = answer.result(timeout=60)
            assert (row.address, row.state, row.passing) == (cell.address, "failed", True)
            assert row.reason.startswith("its process ended with code 0; ")
            assert row_of(cell, out) is None  # it is tried again
            row_path(cell, out).unlink()
            shutil.rmtree(folder)
        rows = [*pool.map(crew.ask, cells)]
        assert [(row.address, row.state) for row in rows] == [(cell.address, "finished") for cell in cells]
        asked = under_way()
        crew.kill()
        assert [answer.result(timeout=60) for answer in asked] == [None, None]
        assert crew.ask(stopped[0]) is None  # and nothing begins any more
    crew.close()
    sweep(plan, place / "alone", executor="here", quiet=True)
    assert results(out) == results(place / "alone")


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
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, list[dict[str, str]], set[str]]]:
    """Workers that are not asked: how many jobs each does at a time, their environments, and the devices of jobs."""
    made: list[tuple[int, list[dict[str, str]], set[str]]] = []

    @contextmanager
    def asked(jobs: list[Cell], workers: list[Any], at_a_time: int = 1) -> Iterator[dict[Future[None], Cell]]:
        made.append((at_a_time, [worker._environment for worker in workers], {job.device for job in jobs}))
        answers = {Future[None](): job for job in jobs}
        for answer in answers:
            answer.set_result(None)
        yield answers

    monkeypatch.setattr(executor_local, "_asked", asked)
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
    assert made == [(1, [{}] * 3, {"cpu"}), (5, [{"CUDA_VISIBLE_DEVICES": name} for name in "01"], {"cuda"})]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-5,MIG-7")
    done(plan | {"seeds": [0, 1], "parts": parts[1:]}, place, Means(per_device=5))
    assert made[2] == (1, [{"CUDA_VISIBLE_DEVICES": name} for name in ("GPU-5", "MIG-7")], {"cuda"})


@pytest.mark.parametrize(("count", "processors", "expected"), [(2, 6, 3), (1, 16, 4), (1, 1, 1), (0, 16, 4)])
def test_how_many_share_a_gpu_unasked(place, plan, made, monkeypatch, count, processors, expected):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(executor_local, "_processors", lambda: processors)
    done(plan | {"seeds": [*range(20)], "device": "cuda"}, place, Means())
    ((at_a_time, environments, _),) = made
    assert (at_a_time, len(environments)) == (expected, max(1, count))
    assert count > 1 or environments == [{}]


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
    """By a stand-in for Ray, which answers that other processes do everything."""
    options: list[dict[str, Any]] = []
    task = SimpleNamespace(remote=lambda *_: object())
    ray: Any = ModuleType("ray")
    ray.is_initialized, ray.cluster_resources = lambda: True, dict
    ray.remote = lambda do: SimpleNamespace(options=lambda **given: options.append(given) or task)
    ray.wait, ray.get = lambda tasks, num_returns: (tasks[:1], tasks[1:]), lambda task: None
    monkeypatch.setitem(sys.modules, "ray", ray)
    cells = cells_of(Plan.from_dict(plan | {"device": device}), place)
    assert [*executor_ray.run(cells, place, Means(gpus=gpus))] == [(cell, None) for cell in cells]
    assert {given["num_gpus"] for given in options} == {asked}


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
