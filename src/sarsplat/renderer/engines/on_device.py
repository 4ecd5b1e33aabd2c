"""Tensors that are sent to a device once and kept there, for each of its queues, and never while a step is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import ParamSpec, TypeVar, cast

import torch

P = ParamSpec("P")
T = TypeVar("T")


class NotRecordable(Exception):
    """What a step does depends on numbers that only the CPU knows, so it cannot be recorded."""


def being_recorded() -> bool:
    """Whether launches are recorded, not run."""
    return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()


_read: list[list[object]] = []
"""What records that are being made read of all that is kept."""


@contextmanager
def read_meanwhile() -> Iterator[list[object]]:
    """What is asked for of all that is kept, in a list: a record needs that for longer than it may be kept here."""
    things: list[object] = []
    _read.append(things)
    try:
        yield things
    finally:
        _read[:] = (other for other in _read if other is not things)


def is_read(thing: T) -> T:
    """Let it live as long as the records that are being made."""
    for things in _read:
        things.append(thing)
    return thing


def queue_of(device: torch.device) -> int:
    """In which of a device's queues this thread works: torch's current stream of a GPU."""
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


def kept_on_device(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a function of hashable arguments, the device being the last, that makes tensors: the latest are kept.

    Each queue has its own. So they are whole before they are read, and what is forgotten is not overwritten while
    another queue reads it; nor do the trainings of other threads drive out what a recorded step reads (recorder.py).
    What were made while a step is recorded would lie in the record's own memory: that is an error, since the steps
    before it have made all that it needs.
    """

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        def made(*arguments: P.args, **named: P.kwargs) -> T:
            if being_recorded():
                raise NotRecordable(f"{make.__name__} sends something to the device in every step")
            return make(*arguments, **named)

        by_queue: dict[int, Callable[P, T]] = {}

        @wraps(make)
        def kept(*arguments: P.args, **named: P.kwargs) -> T:
            queue = queue_of(cast(torch.device, arguments[-1]))
            if queue not in by_queue:
                by_queue.setdefault(queue, lru_cache(maxsize=maxsize)(made))  # type: ignore[arg-type]
            return is_read(by_queue[queue](*arguments, **named))

        return kept

    return decorate
