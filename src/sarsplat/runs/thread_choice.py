"""Choice of the number of threads: on cores that others use, many threads wait for each other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

import torch

_EVERY = 100
"""Steps between trials: the load of the machine and the size of the images change."""

_TIMED = 2
"""Steps of a trial with each number of threads, of which the quicker one counts."""

_HOPELESS = 1.5
"""Time of a step, relative to the quickest, after which more threads are not tried."""

T = TypeVar("T")


class ThreadChoice:
    """Runs steps with the quickest of 1, 2, 4, … threads, found anew every 100 steps.

    The context restores torch's number of threads at its end. Inactive on GPUs and outside of the main thread.
    """

    def __init__(self, device: str) -> None:
        self._most = torch.get_num_threads()
        self._active = device == "cpu" and self._most > 1 and threading.current_thread() is threading.main_thread()
        self._until_trial = 0
        self._untried: list[int] = []
        self._seconds: dict[int, float] = {}

    def __enter__(self) -> ThreadChoice:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._active:
            torch.set_num_threads(self._most)

    def step(self, make: Callable[[], T]) -> T:
        """Run one step and return its result."""
        if not self._active:
            return make()
        if self._until_trial == 0:
            counts = [*(2**k for k in range(self._most.bit_length()) if 2**k < self._most), self._most]
            self._until_trial, self._untried, self._seconds = _EVERY, [n for n in counts for _ in range(_TIMED)], {}
        self._until_trial -= 1
        if not self._untried:
            return make()
        count = self._untried.pop(0)
        torch.set_num_threads(count)
        begun = time.perf_counter()
        made = make()
        took = time.perf_counter() - begun
        self._seconds[count] = min(took, self._seconds.get(count, took))
        if count not in self._untried and self._seconds[count] > _HOPELESS * min(self._seconds.values()):
            self._untried = []
        if not self._untried:
            torch.set_num_threads(min(self._seconds, key=lambda threads: self._seconds[threads]))
        return made
