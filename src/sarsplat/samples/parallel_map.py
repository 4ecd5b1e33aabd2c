"""Parallel map by forked processes; threads would mostly wait for each other."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Generic, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

_MIN_ITEMS = 100
"""Minimum number of items for which processes are started."""

_BATCH = 16
"""Items sent to a process at a time."""

_PR_SET_PDEATHSIG = 1  # of Linux's prctl

T = TypeVar("T")


def parallel_map(work: Callable[[int], T], indices: Sequence[int]) -> Iterator[T]:
    """Map `work` over indices, in order, with as many processes as PyTorch has threads.

    Processes are forked, so only on Linux; elsewhere, and for few indices, this process does the work.
    """
    processes = torch.get_num_threads()
    if processes == 1 or len(indices) < _MIN_ITEMS or sys.platform != "linux":
        yield from map(work, indices)
        return
    loader = DataLoader(
        _Work(work),
        batch_size=None,
        sampler=[indices[first : first + _BATCH] for first in range(0, len(indices), _BATCH)],
        num_workers=processes,
        multiprocessing_context="fork",
        worker_init_fn=_end_with_parent,
    )
    for result in chain.from_iterable(loader):
        if isinstance(result, Exception):
            raise result
        yield result


def _end_with_parent(_: int) -> None:
    """Make a worker ignore SIGTERM to the group, and end when its parent ends, however that ends."""
    if sys.platform == "linux":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # also while it waits for the parent to read


class _Work(Dataset[list[T | Exception]], Generic[T]):
    """Batches of results; exceptions are results, since the loader would add a worker's traceback to their text."""

    def __init__(self, work: Callable[[int], T]) -> None:
        self._work = work

    def __getitem__(self, indices: Sequence[int]) -> list[T | Exception]:
        results: list[T | Exception] = []
        try:
            results += map(self._work, indices)
        except Exception as error:
            results.append(error)
        return results
