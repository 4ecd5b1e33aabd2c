"""Parallel map over chips by processes; threads would mostly wait for each other."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Generic, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

_WORTH_IT = 100
"""Chips for which processes are started."""

_TOGETHER = 16
"""Chips that a process is asked for at a time."""

_PR_SET_PDEATHSIG = 1  # of Linux's prctl

T = TypeVar("T")


def made_each(work: Callable[[int], T], indices: Sequence[int]) -> Iterator[T]:
    """What `work` makes of each number, in order, by as many processes as PyTorch has threads.

    Processes are copies of this one, so only on Linux; elsewhere, and for a few, the work is done here.
    """
    processes = torch.get_num_threads()
    if processes == 1 or len(indices) < _WORTH_IT or sys.platform != "linux":
        yield from map(work, indices)
        return
    loader = DataLoader(
        _Work(work),
        batch_size=None,
        sampler=[indices[first : first + _TOGETHER] for first in range(0, len(indices), _TOGETHER)],
        num_workers=processes,
        multiprocessing_context="fork",
        worker_init_fn=_end_with_the_first,
    )
    for made in chain.from_iterable(loader):
        if isinstance(made, Exception):
            raise made
        yield made


def _end_with_the_first(_: int) -> None:
    """A polite kill of the whole group is for the first process, and that ends the others, however it ends."""
    if sys.platform == "linux":  # where processes are copied
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # one that waits to be listened to would stay


class _Work(Dataset[list[T | Exception]], Generic[T]):
    """Failures are results: raised in a worker they would reach the user with its traceback in their words."""

    def __init__(self, work: Callable[[int], T]) -> None:
        self._work = work

    def __getitem__(self, indices: Sequence[int]) -> list[T | Exception]:
        made: list[T | Exception] = []
        try:
            made += map(self._work, indices)
        except Exception as error:
            made.append(error)
        return made
