"""Runs on this machine: processes with one thread each, which live as long as there is something to do.

As a program, this is such a process: a line of JSON for each job in, one for each result out; it ends with its parent.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

import msgspec

from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.executor import Means
from sarsplat.sweeps.work import Row, do, lost

_SIGNALS = {one.value: one.name for one in signal.Signals}


class Worker:
    """A process that does runs, started when it is first asked, and again where it has died."""

    def __init__(self, out: Path, again: bool) -> None:
        self._out, self._again, self._ended = out, again, False
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, cell: Cell) -> Row | None:
        """Do a run; a process that dies is a row with its reason."""
        if self._process is None:
            self._process = self._started()
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(msgspec.json.encode(cell) + b"\n")
            process.stdin.flush()
        if answer := process.stdout.readline():
            return msgspec.json.decode(answer, type=Row | None)
        code = process.wait()
        self.close()
        if self._ended:
            return None
        by = _SIGNALS.get(-code, f"signal {-code}")
        ended = f"was ended by {by}" if code < 0 else f"ended with code {code}"
        why = ", as when memory runs out: give fewer --processes" if by == "SIGKILL" else ""
        return lost(cell, self._out, f"its process {ended}{why}; start the sweep again to continue it")

    def kill(self) -> None:
        """End it at once: a run may be stopped at any moment."""
        self._ended = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Forget a process that has ended or is about to."""
        if (process := self._process) is not None:
            self._process = None
            with suppress(BrokenPipeError), process:  # closes its pipes and waits for its end
                pass

    def _started(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "sarsplat.sweeps.executor_local", str(self._out), str(self._again)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "OMP_WAIT_POLICY": "PASSIVE",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            },
            start_new_session=True,  # Ctrl-C in the terminal is for the sweep, which ends its workers
        )


def run(cells: Sequence[Cell], out: Path, means: Means) -> Iterator[tuple[Cell, Row | None]]:
    """Do runs on this machine, by default as many at a time as it has processors (see `Executor`)."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(means.processes or processors, len(cells))
    workers = [Worker(out, means.again) for _ in range(count)]
    idle: SimpleQueue[Worker] = SimpleQueue()
    for worker in workers:
        idle.put(worker)

    def one(cell: Cell) -> Row | None:
        worker = idle.get()
        try:
            return worker.ask(cell)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(max(count, 1))
    try:
        futures = {pool.submit(one, cell): cell for cell in cells}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        for worker in workers:
            worker.kill()
        pool.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()


def work(out: Path, again: bool) -> None:
    """Do what lines ask for until there are no more."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever is printed is no answer
    asked: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    while True:
        row = do(msgspec.json.decode(asked.get(), type=Cell), out, again)
        answers.write(msgspec.json.encode(row) + b"\n")
        answers.flush()


def _listen(asked: SimpleQueue[bytes]) -> None:
    """Pass lines on; when there can be no more, whoever asked has ended, and nobody waits for an answer."""
    for line in sys.stdin.buffer:
        asked.put(line)
    os._exit(0)


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.argv[2] == "True")
