"""Processes that do runs: the same bits, and nothing is lost whoever is killed."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from programs import elsewhere
from sarsplat import sweep
from sarsplat.data.files import locked
from sarsplat.executors import Means, executor_local
from sarsplat.sweeps.cell import cells_of
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.work import Row, do, row_path

SLOW = pytest.mark.slow


@pytest.fixture
def expected(place: Path, plan: dict[str, Any], results) -> dict[str, Any]:
    """Of the plan, done in this process."""
    sweep(plan, place / "alone", executor="here", quiet=True)
    return results(place / "alone")


@pytest.fixture
def command(plan_file: None) -> Callable[[], subprocess.Popen[str]]:
    """Starts a sweep of the plan to the folder `out`."""
    words = [sys.executable, "-m", "sarsplat", "sweep", "plan.toml", "--out", "out", "--processes", "1"]
    return lambda: subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def workers() -> list[str]:
    """Command lines of the local executor's processes that belong to a sweep of this folder."""
    started = (" ".join(one.info["cmdline"] or []) for one in psutil.process_iter(["cmdline"]))
    return [words for words in started if str(Path.cwd()) in words and "sarsplat.executors.executor_local" in words]


def test_a_run_in_another_process_is_left_to_it(place, plan, untrained):
    one = cells_of(Plan.from_dict({**plan, "seeds": [0]}), place)[0]
    out = place / "out"
    (out / "rows").mkdir(parents=True)
    with elsewhere(locked(row_path(one, out))):
        assert do(one, out) is None
    assert do(one, out).state == "finished"


def test_as_many_runs_are_done_at_a_time_as_there_are_processes(place, plan, untrained, monkeypatch):
    both = threading.Barrier(2, timeout=60)

    class Here(executor_local.Worker):
        def ask(self, job: Any) -> Row | None:
            both.wait()
            return do(job, self._out)

    monkeypatch.setattr(executor_local, "Worker", Here)
    found = sweep(plan, place / "out", means=Means(processes=2), quiet=True)
    assert all(one.finished for one in found.results)


@SLOW
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_sweep_that_is_ended_leaves_no_process_and_continues(place, plan, expected, results, command, number):
    with command() as process:
        until(lambda: list(Path("out/rows").glob("*.json")) or process.poll() is not None)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number
        assert "what is finished is kept, and `" in said
        assert " sweep plan.toml --out out` with the same options continues" in said
    until(lambda: not workers())
    with command() as process:
        _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert results(place / "out") == expected


@SLOW
def test_two_sweeps_of_one_folder_share_the_work(place, plan, expected, results, command):
    with command() as first, command() as second:
        said = [process.communicate(timeout=180)[1] for process in (first, second)]
    assert [first.returncode, second.returncode] == [0, 0], said
    assert results(place / "out") == expected
    assert len((place / "out" / "results.csv").read_text().splitlines()) == 3
