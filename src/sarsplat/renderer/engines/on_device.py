"""Tensors that are sent to a device once and kept there, whoever needs them, and never while a step is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

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


def kept_on_device(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a function of hashable arguments that makes one tensor or several: the latest results are kept.

    They are whole when they are returned, for other threads use other streams. What were made while a step is recorded
    would lie in the record's own memory: that is an error, since the steps before it have made all that it needs.
    """

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        def made(*arguments: P.args, **named: P.kwargs) -> T:
            if being_recorded():
                raise NotRecordable(f"{make.__name__} sends something to the device in every step")
            result = make(*arguments, **named)
            for tensor in _tensors(result):
                if tensor.is_cuda:
                    torch.cuda.current_stream(tensor.device).synchronize()
            return result

        latest = lru_cache(maxsize=maxsize)(made)
        return wraps(make)(lambda *arguments, **named: is_read(latest(*arguments, **named)))

    return decorate


def _tensors(result: Any) -> Iterable[Tensor]:
    return (result,) if isinstance(result, Tensor) else result
