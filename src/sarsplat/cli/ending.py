"""Signal handling: exit codes, and what an interrupted command says."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALLED = 128
"""And the signal's number: exit codes as in shells."""


class Stopped(KeyboardInterrupt):
    """A signal that ended the work, of which the exit code tells; `text` is what it leaves, and how to go on."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number


def terminate(number: int, frame: FrameType | None) -> None:
    """Handle SIGTERM as Ctrl-C, so that half-written output is removed."""
    raise Stopped(number)


@contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """A signal that ends the block says what is kept."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise Stopped(getattr(interrupt, "number", signal.SIGINT), str(interrupt) or kept()) from None
