"""Number of threads with which steps are quickest: on cores that others use, many threads wait for each other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

import torch

_EVERY = 100
"""Steps from one trial to the next: others come and go, and finer images are more work."""

_TIMED = 2
"""Steps of a trial with each number of threads, of which the quicker one counts."""

_HOPELESS = 1.5
"""Time of a step, relative to the quickest, after which more threads are not tried."""

T = TypeVar("T")


class ThreadChoice:
    """Makes steps with the quickest of 1, 2, 4, … threads, which a trial finds from time to time.

    A context, in whose end torch has the number of threads that it had. Results do not depend on it. Where several
    threads of Python train, it leaves torch's number as it is, which they share.
    """

    def __init__(self, device: str) -> None:
        self._most = torch.get_num_threads()
        self._wanted = device == "cpu" and self._most > 1 and threading.current_thread() is threading.main_thread()
        self._until_trial = 0
        self._untried: list[int] = []
        self._seconds: dict[int, float] = {}

    def __enter__(self) -> ThreadChoice:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._wanted:
            torch.set_num_threads(self._most)

    def step(self, make: Callable[[], T]) -> T:
        """Make a step."""
        if not self._wanted:
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
        if took > _HOPELESS * min(self._seconds.values()) and count > 1:
            self._untried = []
        if not self._untried:
            torch.set_num_threads(min(self._seconds, key=lambda threads: self._seconds[threads]))
        return made
