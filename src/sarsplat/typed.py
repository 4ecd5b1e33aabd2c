"""Plain data as values of given types, by msgspec, from any thread."""

from __future__ import annotations

import threading
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_learned: set[Any] = set()
_learning = threading.Lock()


def decode(data: bytes, kind: type[T]) -> T:
    """What JSON text says, which must be of this type; raises what `msgspec.json.decode` does."""
    _learn(kind)
    return msgspec.json.decode(data, type=kind)


def convert(value: Any, kind: type[T]) -> T:
    """A value of plain data as one of this type; raises what `msgspec.convert` does."""
    _learn(kind)
    return msgspec.convert(value, kind)


def _learn(kind: Any) -> None:
    """Let msgspec learn a type's fields, as it does at first use: two threads that do so at once end the process."""
    if kind not in _learned:
        with _learning:
            msgspec.json.Decoder(kind)
        _learned.add(kind)
