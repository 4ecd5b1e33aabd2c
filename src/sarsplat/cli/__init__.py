"""The command line, `sarsplat`. Commands import what is heavy inside, so that help is instant."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

_INTERRUPTED = 128 + signal.SIGINT  # as shells have it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process unless given.

    Returns
    -------
    int
        Exit code: 0, or 2 after a mistake in the input, or 130 after Ctrl-C. Options that do not parse end the process
        with code 2.
    """
    try:
        from sarsplat.cli.app import run  # here, because Ctrl-C may come while this is imported

        return run(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt as interrupt:
        from sarsplat.cli import console

        console.complain(str(interrupt) or "stopped by Ctrl-C; nothing half-written was left behind")
        return _INTERRUPTED
    finally:
        if arguments is None:  # the process ends: a late Ctrl-C must not make it look as if it had not done its work
            signal.signal(signal.SIGINT, signal.SIG_IGN)


__all__ = ["main"]
