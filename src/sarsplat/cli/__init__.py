"""The command line, `sarsplat`. Commands import what is heavy inside, so that help is instant."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

_INTERRUPTED, _TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # as shells have it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process unless given.

    Returns
    -------
    int
        Exit code: 0, or 2 after a mistake in the input, 130 after Ctrl-C, 143 after being terminated. Options that do
        not parse end the process with code 2.
    """
    try:
        from sarsplat.cli.app import run  # here, because Ctrl-C may come while this is imported

        return run(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt as interrupt:
        from sarsplat.cli import console

        terminated = getattr(interrupt, "number", signal.SIGINT) == signal.SIGTERM
        by = "terminated" if terminated else "stopped by Ctrl-C"
        console.complain(str(interrupt) or f"{by}; nothing half-written was left behind")
        return _TERMINATED if terminated else _INTERRUPTED
    finally:
        if arguments is None:  # the process ends: a late Ctrl-C must not make it look as if it had not done its work
            signal.signal(signal.SIGINT, signal.SIG_IGN)


__all__ = ["main"]
