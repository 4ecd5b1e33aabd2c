"""Calls of libraries with threads that must keep their memory when Ctrl-C interrupts the wait for them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def uninterruptible(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """The result of a call that Ctrl-C does not interrupt.

    scipy's searches with `workers=-1` need this: their threads continue to write into an array that the interrupted
    search has freed, and the process crashes.
    """
    with ThreadPoolExecutor(1) as thread:  # only the main thread is interrupted, and leaving waits for this one
        return thread.submit(function, *arguments, **options).result()
