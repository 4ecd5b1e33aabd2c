"""Local executor: CPU jobs in processes of one thread each, GPU jobs several at a time in a process per GPU."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import torch

from sarsplat.executors.executor import J, Job, Means
from sarsplat.executors.worker import Worker

_MAX_PER_DEVICE = 4
"""Default number of jobs at a time on a GPU. A guess, not measured: one leaves the GPU idle while Python and scores
keep a core busy, but all share the interpreter lock of their process, and memory."""

_VISIBLE = "CUDA_VISIBLE_DEVICES"


class Team:
    """Pool of workers, each with `at_a_time` slots for jobs."""

    def __init__(self, workers: Sequence[Worker], at_a_time: int = 1) -> None:
        self._workers = workers
        self._free: SimpleQueue[Worker] = SimpleQueue()
        for worker in [*workers] * at_a_time:  # every GPU gets one before any gets two
            self._free.put(worker)
        self._pool = ThreadPoolExecutor(len(workers) * at_a_time)

    def submit(self, jobs: Sequence[J]) -> dict[Future[Any], J]:
        """Queue jobs for the next free slots."""
        return {self._pool.submit(self._one, job): job for job in jobs}

    def _one(self, job: Job) -> Any:
        worker = self._free.get()
        try:
            return worker.ask(job)
        finally:
            self._free.put(worker)

    def end(self) -> None:
        """Kill all workers and wait for their end."""
        for worker in self._workers:
            worker.kill()
        self._pool.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()


def run(jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
    """Do jobs on this machine (see `Executor`), by default one per processor and up to four per GPU."""
    teams: list[Team] = []
    jobs_by_future: dict[Future[Any], J] = {}
    try:
        if on_cpu := [job for job in jobs if job.device != "cuda"]:
            count = min(means.processes or _processors(), len(on_cpu))
            teams.append(Team([Worker(jobs[0].work, out, means.again) for _ in range(count)]))
            jobs_by_future |= teams[-1].submit(on_cpu)
        if on_gpu := [job for job in jobs if job.device == "cuda"]:
            gpus = _gpus()[: len(on_gpu)]
            at_a_time = means.per_device or min(_MAX_PER_DEVICE, max(1, _processors() // len(gpus)))
            at_a_time = min(at_a_time, -(-len(on_gpu) // len(gpus)))
            teams.append(Team([Worker(jobs[0].work, out, means.again, at_a_time, gpu) for gpu in gpus], at_a_time))
            jobs_by_future |= teams[-1].submit(on_gpu)
        for future in as_completed(jobs_by_future):
            yield jobs_by_future[future], future.result()
    finally:
        for team in teams:
            team.end()


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
