"""A signal as an exception, so that what is half-written is removed."""

from __future__ import annotations

from types import FrameType


class Stopped(KeyboardInterrupt):
    """A signal that ended the work; the exit code says which."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number


def stop(number: int, frame: FrameType | None) -> None:
    """What to do on a polite kill: the same as on Ctrl-C."""
    raise Stopped(number)
