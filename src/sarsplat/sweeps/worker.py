"""A process that does runs, one or several at a time; it lives as long as there is something to do.

As a program, this is such a process: a line of JSON for each job in, one for each result out; it ends with its parent.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import BinaryIO

import msgspec
import torch

from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import Row, do, lost

_SIGNALS = {one.value: one.name for one in signal.Signals}

_BROKEN_GPU = 75
"""Exit code of a process whose GPU does nothing more."""

Answer = tuple[str, Row | None]
"""The address of a run, and its row; None if another process is doing it."""


class Worker:
    """Such a process, started when it is first asked, and again where it has died.

    Parameters
    ----------
    out : Path
        Folder of the sweep.
    again : bool
        Whether failed runs are tried again.
    at_a_time : int
        How many threads ask at a time, for as many runs.
    environment : mapping of str to str
        Variables that are other ones there.
    """

    def __init__(
        self, out: Path, again: bool, at_a_time: int = 1, environment: Mapping[str, str] | None = None
    ) -> None:
        self._words = [str(out), str(again), str(at_a_time)]
        self._out, self._environment, self._ended = out, environment or {}, False
        self._process: subprocess.Popen[bytes] | None = None
        self._listener: threading.Thread | None = None
        self._asked: dict[str, tuple[Cell, Future[Row | None]]] = {}
        self._lock = threading.Lock()

    def ask(self, cell: Cell) -> Row | None:
        """Do a run; a process that dies is a row with its reason, for every run that it was asked for."""
        answer: Future[Row | None] = Future()
        with self._lock:
            if self._ended:
                return None
            if self._process is None:
                self._process = self._started()
                self._listener = threading.Thread(target=self._listen, args=(self._process,), daemon=True)
                self._listener.start()
            self._asked[cell.address] = cell, answer
            assert self._process.stdin is not None
            with suppress(BrokenPipeError):
                self._process.stdin.write(msgspec.json.encode(cell) + b"\n")
                self._process.stdin.flush()
        return answer.result()

    def kill(self) -> None:
        """End it at once: a run may be stopped at any moment."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """Wait for the end of a process that was killed."""
        if self._listener is not None:
            self._listener.join()

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """Hand out the answers of a process, and after its end the rows of those runs that it was at."""
        assert process.stdout is not None
        for line in process.stdout:
            if line.endswith(b"\n"):  # not half a line, which was its last
                address, row = msgspec.json.decode(line, type=Answer)
                self._asked.pop(address)[1].set_result(row)
        code = process.wait()
        with self._lock:
            unanswered, self._asked, self._process = self._asked, {}, None
            with suppress(BrokenPipeError), process:  # closes its pipes
                pass
        for cell, answer in unanswered.values():
            try:
                answer.set_result(None if self._ended else lost(cell, self._out, _why(cell, code)))
            except Exception as error:  # the sweep's: it cannot write
                answer.set_exception(error)

    def _started(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "sarsplat.sweeps.worker", *self._words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "OMP_WAIT_POLICY": "PASSIVE",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                **self._environment,
            },
            start_new_session=True,  # Ctrl-C in the terminal is for the sweep, which ends its workers
        )


def _why(cell: Cell, code: int) -> str:
    """Why a run was lost when its process ended with a code, in a sentence."""
    if code == _BROKEN_GPU:
        return "the GPU failed in another run of its process; start the sweep again to continue it"
    by = _SIGNALS.get(-code, f"signal {-code}")
    ended = f"was ended by {by}" if code < 0 else f"ended with code {code}"
    fewer = "--per-device" if cell.device == "cuda" else "--processes"
    why = f", as when memory runs out: give fewer {fewer}" if by == "SIGKILL" else ""
    return f"its process {ended}{why}; start the sweep again to continue it"


def work(out: Path, again: bool, at_a_time: int) -> None:
    """Do what lines ask for, so many at a time, until there are no more."""
    answers = Answers(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # whatever is printed is no answer
    asked: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    for _ in range(at_a_time - 1):
        threading.Thread(target=serve, args=(asked, answers, out, again), daemon=True).start()
    serve(asked, answers, out, again)


class Answers:
    """Where threads write their answers, each a line."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._lock = file, threading.Lock()

    def put(self, answer: Answer) -> None:
        with self._lock:
            self._file.write(msgspec.json.encode(answer) + b"\n")
            self._file.flush()


def serve(asked: SimpleQueue[bytes], answers: Answers, out: Path, again: bool) -> None:
    """Do one run after the other; those on a GPU in a queue of their own there, beside those of other threads."""
    stream = None
    while True:
        cell = msgspec.json.decode(asked.get(), type=Cell)
        on_gpu = cell.device == "cuda" and torch.cuda.is_available()
        if on_gpu and stream is None:
            stream = torch.cuda.Stream()
        with torch.cuda.stream(stream) if on_gpu else nullcontext():
            answers.put((cell.address, do(cell, out, again)))
        if stream is not None:
            try:
                stream.synchronize()
            except RuntimeError:  # after such an error, a process gets nothing but errors from its GPU
                os._exit(_BROKEN_GPU)


def _listen(asked: SimpleQueue[bytes]) -> None:
    """Pass lines on; when there can be no more, whoever asked has ended, and nobody waits for an answer."""
    for line in sys.stdin.buffer:
        asked.put(line)
    os._exit(0)


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.argv[2] == "True", int(sys.argv[3]))
