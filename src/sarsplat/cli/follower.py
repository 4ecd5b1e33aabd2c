"""Silence of all torchrun processes but the first, so that nothing is printed twice."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress

from sarsplat.cli.stopped import SIGNALLED, Stopped, terminate

ABANDONED = 75
"""Exit code where another process has ended: whoever is left says so at once."""

_PATIENCE_S = 5.0
"""For the first process to end, whereupon torchrun ends this one."""


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
