"""Protection of threaded library calls from Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def uninterruptible(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return the result of a call that Ctrl-C does not interrupt.

    scipy's searches with `workers=-1` need this: after an interrupt, their threads write into freed memory, and the
    process crashes.
    """
    with ThreadPoolExecutor(1) as thread:  # only the main thread is interrupted, and leaving waits for this one
        return thread.submit(function, *arguments, **options).result()
