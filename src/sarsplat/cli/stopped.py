"""How a signal ends a command."""

from __future__ import annotations

from types import FrameType

SIGNALLED = 128
"""And the signal's number: exit codes as in shells."""


class Stopped(KeyboardInterrupt):
    """A signal that ended the work; the exit code says which."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number


def terminate(number: int, frame: FrameType | None) -> None:
    """Handle SIGTERM as Ctrl-C, so that half-written output is removed."""
    raise Stopped(number)
