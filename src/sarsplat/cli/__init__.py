"""Command line `sarsplat`. Commands import heavy packages inside, so that help is instant."""

import signal
import sys
import threading
from collections.abc import Sequence

from sarsplat.cli.signals import SIGNALLED, terminate


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
    main_thread = threading.current_thread() is threading.main_thread()  # the only one that receives signals
    previous = signal.signal(signal.SIGTERM, terminate) if main_thread else None
    try:
        from sarsplat.cli.app import run  # here, because Ctrl-C may come while this is imported

        return run(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt as interrupt:
        from sarsplat.cli import console

        number = getattr(interrupt, "number", signal.SIGINT)
        by = "terminated" if number == signal.SIGTERM else "stopped by Ctrl-C"
        console.complain(f"{by}; {interrupt}" if interrupt.args else f"{by}; nothing half-written was left behind")
        return SIGNALLED + number
    finally:
        if main_thread:
            signal.signal(signal.SIGTERM, previous)
        if arguments is None:  # the process ends: a late Ctrl-C must not hide that its work is done
            signal.signal(signal.SIGINT, signal.SIG_IGN)


__all__ = ["main"]
