"""Library calls that threads or Ctrl-C would crash: decoding into types by msgspec, and searches by many threads."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_prepared: set[Any] = set()
_lock = threading.Lock()


def decode(data: bytes, kind: type[T]) -> T:
    """Decode JSON as a type; raise as `msgspec.json.decode` does."""
    _prepare(kind)
    return msgspec.json.decode(data, type=kind)


def convert(value: Any, kind: type[T]) -> T:
    """Convert plain data to a type; raise as `msgspec.convert` does."""
    _prepare(kind)
    return msgspec.convert(value, kind)


def _prepare(kind: Any) -> None:
    """Prepare msgspec for a type under a lock: first uses of a type in two threads at once crash the process."""
    if kind not in _prepared:
        with _lock:
            msgspec.json.Decoder(kind)
        _prepared.add(kind)


def uninterruptible(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return the result of a call that Ctrl-C does not interrupt.

    scipy's searches with `workers=-1` need this: after an interrupt, their threads write into freed memory, and the
    process crashes.
    """
    with ThreadPoolExecutor(1) as thread:  # only the main thread is interrupted, and leaving waits for this one
        return thread.submit(function, *arguments, **options).result()
