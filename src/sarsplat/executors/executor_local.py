"""Jobs on this machine: on the CPU in processes with one thread each, on a GPU several at a time in one process."""

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

_PER_DEVICE = 4
"""Trainings of a GPU at a time, unless it is said. A guess, not measured: one should leave the GPU idle while Python
and scores keep a core busy, but they all wait for the one Python of their process, and for memory."""

_VISIBLE = "CUDA_VISIBLE_DEVICES"


class Team:
    """Workers that share jobs, each with places for so many at a time."""

    def __init__(self, workers: Sequence[Worker], at_a_time: int = 1) -> None:
        self._workers = workers
        self._free: SimpleQueue[Worker] = SimpleQueue()
        for worker in [*workers] * at_a_time:  # so that every GPU gets one before any gets two
            self._free.put(worker)
        self._pool = ThreadPoolExecutor(len(workers) * at_a_time)

    def ask(self, jobs: Sequence[J]) -> dict[Future[Any], J]:
        """Have these done, one after the other as places become free."""
        return {self._pool.submit(self._one, job): job for job in jobs}

    def _one(self, job: Job) -> Any:
        worker = self._free.get()
        try:
            return worker.ask(job)
        finally:
            self._free.put(worker)

    def end(self) -> None:
        """Stop what is left at once."""
        for worker in self._workers:
            worker.kill()
        self._pool.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()


def run(jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
    """Do jobs on this machine (see `Executor`).

    Of those on the CPU there are as many at a time as there are processors, and of those on GPUs, at most four on each.
    """
    teams: list[Team] = []
    asked: dict[Future[Any], J] = {}
    try:
        if on_cpu := [job for job in jobs if job.device != "cuda"]:
            count = min(means.processes or _processors(), len(on_cpu))
            teams.append(Team([Worker(jobs[0].work, out, means.again) for _ in range(count)]))
            asked |= teams[-1].ask(on_cpu)
        if on_gpu := [job for job in jobs if job.device == "cuda"]:
            gpus = _gpus()[: len(on_gpu)]
            at_a_time = means.per_device or min(_PER_DEVICE, max(1, _processors() // len(gpus)))
            at_a_time = min(at_a_time, -(-len(on_gpu) // len(gpus)))
            teams.append(Team([Worker(jobs[0].work, out, means.again, at_a_time, gpu) for gpu in gpus], at_a_time))
            asked |= teams[-1].ask(on_gpu)
        for future in as_completed(asked):
            yield asked[future], future.result()
    finally:
        for team in teams:
            team.end()


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpus() -> list[dict[str, str]]:
    """By which environment a process sees each GPU that torch sees here, and no other; without any, as it is here."""
    count = torch.cuda.device_count()
    if count < 2:
        return [{}]
    named = os.environ.get(_VISIBLE)
    names = named.split(",") if named else [*map(str, range(count))]
    return [{_VISIBLE: name} for name in names[:count]]
