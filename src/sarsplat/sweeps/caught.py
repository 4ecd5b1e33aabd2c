"""What is warned of, told apart by the thread that warns: `warnings.catch_warnings` alone is for a whole process."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from sarsplat.errors import SarsplatWarning

_lock = threading.Lock()
_lists: dict[int, list[str]] = {}
"""By thread."""

_usual = ExitStack()
"""Brings the usual warnings back."""


@contextmanager
def caught() -> Iterator[list[str]]:
    """What is warned of with a `SarsplatWarning` while the block runs, by this thread; other warnings are not shown.

    Warnings of threads that have no such block, as libraries start them, are those of every block.
    """
    mine: list[str] = []
    with _lock:
        if not _lists:
            _usual.enter_context(warnings.catch_warnings())
        warnings.simplefilter("always", SarsplatWarning)  # anew: a library's own block may have put older filters back
        warnings.showwarning = _keep  # type: ignore[assignment]
        _lists[threading.get_ident()] = mine
    try:
        yield mine
    finally:
        with _lock:
            del _lists[threading.get_ident()]
            if not _lists:
                _usual.close()


def _keep(message: Warning | str, category: type[Warning], *place: object) -> None:
    if issubclass(category, SarsplatWarning):
        own = _lists.get(threading.get_ident())
        for each in [*_lists.values()] if own is None else [own]:
            each.append(str(message))
