"""How a signal ends a command, and the silence of all torchrun processes but the first: nothing is printed twice."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from types import FrameType

SIGNALLED = 128
"""And the signal's number: exit codes as in shells."""

ABANDONED = 75
"""Exit code where another process has ended: whoever is left says so at once."""

_PATIENCE_S = 5.0
"""For the first process to end, whereupon torchrun ends this one."""


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


def follows() -> bool:
    """Whether this process is one of those."""
    return "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("RANK", "0") != "0"


def follow(work: Callable[[], int]) -> int:
    """Do a command in silence; what went wrong in this process alone is said in the end."""
    said, code = io.StringIO(), 2
    with redirect_stdout(io.StringIO()), redirect_stderr(said):
        try:
            code = work()
        except SystemExit as ended:  # options that do not parse
            code = ended.code if isinstance(ended.code, int) else code
    if code == 0 or code > SIGNALLED:
        return code
    with suppress(Stopped):  # the first has said it, and torchrun ends the others
        if code != ABANDONED:
            signal.signal(signal.SIGTERM, terminate)
            time.sleep(_PATIENCE_S)
        sys.stderr.write(said.getvalue())
    return code
