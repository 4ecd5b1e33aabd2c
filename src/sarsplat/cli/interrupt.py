"""Ctrl-C between two steps, never within one: what is saved then can be resumed bit for bit."""

from __future__ import annotations

import os
import shlex
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType


class Stopped(KeyboardInterrupt):
    """A signal that ended a training between two steps; the exit code tells which, as shells have it."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number

    @property
    def by(self) -> str:
        """What happened, in words."""
        return "terminated" if self.number == signal.SIGTERM else "stopped by Ctrl-C"


@contextmanager
def interrupts_held_back() -> Iterator[Callable[[], int]]:
    """Hold back Ctrl-C (and a polite kill) inside the block; the yielded function gives the signal's number, or 0.

    A second Ctrl-C is not held back. Outside the main thread, where no signal arrives, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return
    asked = 0

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise Stopped(number)
        asked = number
        os.write(2, b"\nstopping after this step; once more stops at once\n")  # print must not be called in here

    before = {number: signal.signal(number, hold) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible(dataset: Path, out: Path) -> Iterator[Callable[[object], None]]:
    """A training that Ctrl-C ends between two steps; the yielded function is called after each.

    Raises
    ------
    KeyboardInterrupt
        If there was one; it says how to resume, if there is a checkpoint.
    """
    with interrupts_held_back() as interrupted:

        def stop_if_asked(step: object) -> None:
            if number := interrupted():
                raise Stopped(number)

        try:
            yield stop_if_asked
        except KeyboardInterrupt as interrupt:
            if interrupt.args or not (out / "config.json").is_file():
                raise
            stopped = interrupt if isinstance(interrupt, Stopped) else Stopped(signal.SIGINT)
            raise Stopped(
                stopped.number,
                f"{stopped.by}; {out} keeps the progress so far; continue with "
                f"`sarsplat reconstruct {shlex.quote(str(dataset))} --out {shlex.quote(str(out))} --resume`",
            ) from None
