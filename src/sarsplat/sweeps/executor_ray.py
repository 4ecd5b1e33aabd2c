"""Runs on a Ray cluster, whose nodes all see the folders of the datasets and of the sweep."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from sarsplat.errors import SarsplatError, shown
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.executor import Means
from sarsplat.sweeps.work import Row, do, lost

_AHEAD = 4
"""Runs that are handed to the cluster at a time, for each of its processors: waiting for many takes long."""


def run(cells: Sequence[Cell], out: Path, means: Means) -> Iterator[tuple[Cell, Row | None]]:
    """Do runs on a cluster, each on one processor (see `Executor`); Ray starts those again whose node has died."""
    import ray

    ours = not ray.is_initialized()
    if ours:
        terminate = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address=means.address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
            raise SarsplatError(
                f"there is no Ray cluster at {shown(means.address)} ({shown(str(error))}); start one with "
                "`ray start --head`, or give its address"
            ) from error
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, terminate)  # Ray's own ends the process without a word
    running: dict[Any, Cell] = {}
    waiting = list(reversed(cells))
    remote = ray.remote(_do)
    try:
        while waiting or running:
            ahead = _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and len(running) < ahead:
                cell = waiting.pop()
                gpus = means.gpus if means.gpus is not None else float(cell.device == "cuda")
                task = remote.options(num_cpus=1, num_gpus=gpus, max_retries=means.retries, name=cell.address)
                running[task.remote(msgspec.to_builtins(cell), str(out), means.again)] = cell
            (ready, *_), _ = ray.wait(list(running), num_returns=1)
            cell = running.pop(ready)
            yield cell, _row(ray, ready, cell, out)
    finally:
        for task in running:
            ray.cancel(task, force=True)
        if ours:
            ray.shutdown()


def _do(cell: dict[str, Any], out: str, again: bool) -> dict[str, Any] | None:
    """Remote function of Ray: `do`, with plain data as arguments and result."""
    row = do(msgspec.convert(cell, Cell), Path(out), again)
    return None if row is None else msgspec.to_builtins(row)


def _row(ray: Any, task: Any, cell: Cell, out: Path) -> Row | None:
    try:
        answer = ray.get(task)
    except ray.exceptions.RayError as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        return lost(cell, out, f"its node or process ended too often ({first}); start the sweep again to continue it")
    return None if answer is None else msgspec.convert(answer, Row)
