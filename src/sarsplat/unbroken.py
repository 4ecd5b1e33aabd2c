"""Calls of libraries whose threads must not lose what they work on when Ctrl-C ends the wait for them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def unbroken(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What a call returns; Ctrl-C waits for its end.

    scipy's searches with `workers=-1` need this: their threads go on writing into an array that the interrupted
    search has freed, and the process dies.
    """
    with ThreadPoolExecutor(1) as thread:  # only the main thread is interrupted, and leaving waits for this one
        return thread.submit(function, *arguments, **options).result()
