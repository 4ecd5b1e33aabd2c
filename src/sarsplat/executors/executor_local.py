"""Local executor: CPU jobs in processes of one thread each, GPU jobs several at a time in a process per GPU.

The module is also the program of these processes: JSON lines of jobs in, of results out; it ends with its parent.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgspec
import torch

from sarsplat.executors.executor import J, Job, Means, Work, work_named
from sarsplat.threads import decode

_MAX_PER_DEVICE = 4
"""Default number of jobs at a time on a GPU. A guess, not measured: one leaves the GPU idle while Python and scores
keep a core busy, but all share the interpreter lock of their process, and memory."""

_VISIBLE = "CUDA_VISIBLE_DEVICES"

_SIGNALS = {one.value: one.name for one in signal.Signals}

_BROKEN_GPU = 75  # exit code of a worker whose GPU has failed


def run(jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
    """Do jobs on this machine (see `Executor`), by default one per processor and up to four per GPU."""
    jobs_by_future: dict[Future[Any], J] = {}
    with ExitStack() as stack:
        if on_cpu := [job for job in jobs if job.device != "cuda"]:
            count = min(means.processes or _processors(), len(on_cpu))
            workers = [Worker(jobs[0].work, out, means.again) for _ in range(count)]
            jobs_by_future |= stack.enter_context(_asked(on_cpu, workers))
        if on_gpu := [job for job in jobs if job.device == "cuda"]:
            gpus = _gpus()[: len(on_gpu)]
            at_a_time = means.per_device or min(_MAX_PER_DEVICE, max(1, _processors() // len(gpus)))
            at_a_time = min(at_a_time, -(-len(on_gpu) // len(gpus)))
            workers = [Worker(jobs[0].work, out, means.again, at_a_time, gpu) for gpu in gpus]
            jobs_by_future |= stack.enter_context(_asked(on_gpu, workers, at_a_time))
        for future in as_completed(jobs_by_future):
            yield jobs_by_future[future], future.result()


@contextmanager
def _asked(jobs: Sequence[J], workers: "Sequence[Worker]", at_a_time: int = 1) -> Iterator[dict[Future[Any], J]]:
    """Ask workers, each for `at_a_time` jobs at a time; yield the results to come. Workers are killed at the end."""
    free: SimpleQueue[Worker] = SimpleQueue()
    for worker in [*workers] * at_a_time:  # every GPU gets a job before any gets two
        free.put(worker)

    def ask(job: Job) -> Any:
        worker = free.get()
        try:
            return worker.ask(job)
        finally:
            free.put(worker)

    pool = ThreadPoolExecutor(len(workers) * at_a_time)
    try:
        yield {pool.submit(ask, job): job for job in jobs}
    finally:
        for worker in workers:
            worker.kill()
        pool.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpus() -> list[dict[str, str]]:
    """Return an environment for each visible GPU in which a process sees only that one; [{}] for at most one."""
    count = torch.cuda.device_count()
    if count < 2:
        return [{}]
    visible = os.environ.get(_VISIBLE)
    names = visible.split(",") if visible else [*map(str, range(count))]
    return [{_VISIBLE: name} for name in names[:count]]


class Worker:
    """Handle of a worker process, which starts with the first job and again after it has died.

    `work` is the address of the `Work` of all its jobs, `out` their output folder. With `again`, failed jobs are
    retried. It does `at_a_time` jobs at a time, each asked from another thread. `environment` holds the environment
    variables that differ in the process.
    """

    def __init__(
        self, work: str, out: Path, again: bool, at_a_time: int = 1, environment: Mapping[str, str] | None = None
    ) -> None:
        self._arguments = [work, str(out), str(again), str(at_a_time)]
        self._work, self._out, self._environment, self._ended = work_named(work), out, environment or {}, False
        self._process: subprocess.Popen[bytes] | None = None
        self._listener: threading.Thread | None = None
        self._asked: dict[str, tuple[Job, Future[Any]]] = {}
        self._lock = threading.Lock()

    def ask(self, job: Job) -> Any:
        """Do a job and return its result; if the process dies, that of `Work.lost`."""
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
        """Kill the process at once, in whatever job."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """Wait for the end of a killed process."""
        if self._listener is not None:
            self._listener.join()

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """Pass on the results of a process and, after its end, `Work.lost` for its unfinished jobs."""
        assert process.stdout is not None
        kind: Any = tuple[str, self._work.result | None]  # type: ignore[name-defined]
        for line in process.stdout:
            if line.endswith(b"\n"):  # complete, unlike the last line of a killed process
                address, result = decode(line, kind)
                self._asked.pop(address)[1].set_result(result)
        code = process.wait()
        with self._lock:
            unanswered, self._asked, self._process = self._asked, {}, None
            with suppress(BrokenPipeError), process:  # closes its pipes
                pass
        for job, answer in unanswered.values():
            try:
                lost = None if self._ended else self._work.lost(job, self._out, _reason(job, code, self._work.go_on))
                answer.set_result(lost)
            except Exception as error:  # such as a full disk
                answer.set_exception(error)

    def _started(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "sarsplat.executors.executor_local", *self._arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "OMP_WAIT_POLICY": "PASSIVE",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                **self._environment,
            },
            start_new_session=True,  # Ctrl-C reaches the parent, which kills the workers
        )


def _reason(job: Job, code: int, go_on: str) -> str:
    """Describe the loss of a job by its process's exit code."""
    if code == _BROKEN_GPU:
        return f"the GPU failed in another run of its process; {go_on}"
    by = _SIGNALS.get(-code, f"signal {-code}")
    ended = f"was ended by {by}" if code < 0 else f"ended with code {code}"
    fewer = "`per_device`" if job.device == "cuda" else "`processes`"
    hint = f", as when memory runs out: give fewer {fewer}" if by == "SIGKILL" else ""
    return f"its process {ended}{hint}; {go_on}"


# ---- the process ----
def work(kind: Work, out: Path, again: bool, at_a_time: int) -> None:
    """Do the jobs on stdin, `at_a_time` at once, until it closes; answer on stdout, a line for each."""
    file, lock = os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)  # prints go to stderr

    def answer(job: Job, result: Any) -> None:
        with lock:
            file.write(msgspec.json.encode((job.address, result)) + b"\n")
            file.flush()

    asked: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    for _ in range(at_a_time - 1):
        threading.Thread(target=serve, args=(kind, asked, answer, out, again), daemon=True).start()
    serve(kind, asked, answer, out, again)


def serve(kind: Work, asked: SimpleQueue[bytes], answer: Callable[[Job, Any], None], out: Path, again: bool) -> None:
    """Do queued jobs one after the other; on a GPU, in a separate CUDA stream per thread."""
    stream = None
    while True:
        job = decode(asked.get(), kind.job)
        on_gpu = job.device == "cuda" and torch.cuda.is_available()
        if on_gpu and stream is None:
            stream = torch.cuda.Stream()
        with torch.cuda.stream(stream) if on_gpu else nullcontext():
            answer(job, kind.do(job, out, again))
        if stream is not None:
            try:
                stream.synchronize()
            except RuntimeError:  # the CUDA context is lost
                os._exit(_BROKEN_GPU)


def _listen(asked: SimpleQueue[bytes]) -> None:
    """Queue the lines of stdin; exit when it closes, since the parent has ended."""
    for line in sys.stdin.buffer:
        asked.put(line)
    os._exit(0)


if __name__ == "__main__":
    work(work_named(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "True", int(sys.argv[4]))
