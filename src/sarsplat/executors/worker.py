"""A process that does jobs, one or several at a time; it lives as long as there is something to do.

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
from typing import Any, BinaryIO

import msgspec
import torch

from sarsplat.executors.executor import Job, Work, work_named
from sarsplat.typed import decode

_SIGNALS = {one.value: one.name for one in signal.Signals}

_BROKEN_GPU = 75
"""Exit code of a process whose GPU does nothing more."""

Answer = tuple[str, Any]
"""The address of a job, and its result; None if another process is doing it."""


class Worker:
    """Such a process, started when it is first asked, and again where it has died.

    Parameters
    ----------
    work : str
        Kind of all jobs that it is asked for.
    out : Path
        Folder that they write to.
    again : bool
        Whether failed ones are tried again.
    at_a_time : int
        How many threads ask at a time, for as many jobs.
    environment : mapping of str to str
        Variables that are other ones there.
    """

    def __init__(
        self, work: str, out: Path, again: bool, at_a_time: int = 1, environment: Mapping[str, str] | None = None
    ) -> None:
        self._words = [work, str(out), str(again), str(at_a_time)]
        self._work, self._out, self._environment, self._ended = work_named(work), out, environment or {}, False
        self._process: subprocess.Popen[bytes] | None = None
        self._listener: threading.Thread | None = None
        self._asked: dict[str, tuple[Job, Future[Any]]] = {}
        self._lock = threading.Lock()

    def ask(self, job: Job) -> Any:
        """Do a job; a process that dies is a result with its reason, for every job that it was asked for."""
        answer: Future[Any] = Future()
        with self._lock:
            if self._ended:
                return None
            if self._process is None:
                self._process = self._started()
                self._listener = threading.Thread(target=self._listen, args=(self._process,), daemon=True)
                self._listener.start()
            self._asked[job.address] = job, answer
            assert self._process.stdin is not None
            with suppress(BrokenPipeError):
                self._process.stdin.write(msgspec.json.encode(job) + b"\n")
                self._process.stdin.flush()
        return answer.result()

    def kill(self) -> None:
        """End it at once: a job may be stopped at any moment."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """Wait for the end of a process that was killed."""
        if self._listener is not None:
            self._listener.join()

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """Hand out the answers of a process, and after its end the results of those jobs that it was at."""
        assert process.stdout is not None
        kind: Any = tuple[str, self._work.result | None]  # type: ignore[name-defined]
        for line in process.stdout:
            if line.endswith(b"\n"):  # not half a line, which was its last
                address, result = decode(line, kind)
                self._asked.pop(address)[1].set_result(result)
        code = process.wait()
        with self._lock:
            unanswered, self._asked, self._process = self._asked, {}, None
            with suppress(BrokenPipeError), process:  # closes its pipes
                pass
        for job, answer in unanswered.values():
            try:
                lost = None if self._ended else self._work.lost(job, self._out, _why(job, code, self._work.go_on))
                answer.set_result(lost)
            except Exception as error:  # of whoever asks: it cannot write
                answer.set_exception(error)

    def _started(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "sarsplat.executors.worker", *self._words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "OMP_WAIT_POLICY": "PASSIVE",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                **self._environment,
            },
            start_new_session=True,  # Ctrl-C in the terminal is for whoever asks, who ends the workers
        )


def _why(job: Job, code: int, go_on: str) -> str:
    """Why a job was lost when its process ended with a code, in a sentence."""
    if code == _BROKEN_GPU:
        return f"the GPU failed in another run of its process; {go_on}"
    by = _SIGNALS.get(-code, f"signal {-code}")
    ended = f"was ended by {by}" if code < 0 else f"ended with code {code}"
    fewer = "--per-device" if job.device == "cuda" else "--processes"
    why = f", as when memory runs out: give fewer {fewer}" if by == "SIGKILL" else ""
    return f"its process {ended}{why}; {go_on}"


def work(kind: Work, out: Path, again: bool, at_a_time: int) -> None:
    """Do what lines ask for, so many at a time, until there are no more."""
    answers = Answers(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # whatever is printed is no answer
    asked: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    for _ in range(at_a_time - 1):
        threading.Thread(target=serve, args=(kind, asked, answers, out, again), daemon=True).start()
    serve(kind, asked, answers, out, again)


class Answers:
    """Where threads write their answers, each a line."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._lock = file, threading.Lock()

    def put(self, answer: Answer) -> None:
        with self._lock:
            self._file.write(msgspec.json.encode(answer) + b"\n")
            self._file.flush()


def serve(kind: Work, asked: SimpleQueue[bytes], answers: Answers, out: Path, again: bool) -> None:
    """Do one job after the other; those on a GPU in a queue of their own there, beside those of other threads."""
    stream = None
    while True:
        job = decode(asked.get(), kind.job)
        on_gpu = job.device == "cuda" and torch.cuda.is_available()
        if on_gpu and stream is None:
            stream = torch.cuda.Stream()
        with torch.cuda.stream(stream) if on_gpu else nullcontext():
            answers.put((job.address, kind.do(job, out, again)))
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
    work(work_named(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "True", int(sys.argv[4]))
