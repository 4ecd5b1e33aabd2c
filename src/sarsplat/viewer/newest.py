"""Work that follows the mouse: only the newest position is worth drawing."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable


class Newest:
    """Does one piece of work on a thread of its own whenever it is asked to, never twice at once.

    What is asked for while it works is done once, after that, however often it was asked for: the work looks up the
    newest state itself. An error is logged, and the next request is served all the same.

    Parameters
    ----------
    work : callable
        Takes nothing; what it returns is ignored.
    """

    def __init__(self, work: Callable[[], object]) -> None:
        self._work = work
        self._changed = threading.Condition()
        self._asked = self._busy = self._closed = False
        self.done = 0
        self._thread = threading.Thread(target=self._run, name="sarsplat-view", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """Let the work be done, soon."""
        with self._changed:
            self._asked = True
            self._changed.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Wait until nothing is left to do; whether that came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._asked or self._busy), timeout_s)

    def close(self) -> None:
        """Finish what is being done, and do no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._closed)
                if self._closed:
                    return
                self._asked, self._busy = False, True
            try:
                self._work()
            except Exception:
                logging.getLogger("sarsplat").exception("the picture could not be drawn")
            with self._changed:
                self._busy = False
                self.done += 1
                self._changed.notify_all()
