"""Thread-safe decoding of JSON and plain data into types by msgspec."""

from __future__ import annotations

import threading
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
