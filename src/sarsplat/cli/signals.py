"""Signal handling: exit codes and messages of interrupted commands."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALLED = 128
"""Exit code of interrupted commands, to which the signal's number is added, as in shells."""


class Stopped(KeyboardInterrupt):
    """Signal that ended the work; `text` names the results and the command to go on."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number


def terminate(number: int, frame: FrameType | None) -> None:
    """Handle SIGTERM as Ctrl-C, so that half-written output is removed."""
    raise Stopped(number)


@contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """Add a sentence about kept results to a signal that ends the block."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise Stopped(getattr(interrupt, "number", signal.SIGINT), str(interrupt) or kept()) from None
