"""Worker thread that only serves the newest request, such as rendering while the mouse moves."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for


class Newest:
    """Thread that runs one function on request, never twice at once.

    Requests during a run lead to a single further run: the function reads the newest state itself. Errors are logged
    and do not stop the thread.
    """

    def __init__(self, work: Callable[[], object]) -> None:
        self._work = work
        self._pool = ThreadPoolExecutor(1, "sarsplat-view")
        self._asking = threading.Lock()
        self._last: Future[None] | None = None
        self._closed = False
        self.done = 0

    def ask(self) -> None:
        """Request the work; it starts as soon as the thread is free."""
        with self._asking:
            waiting = self._last is not None and not (self._last.running() or self._last.done())
            if not waiting and not self._closed:
                self._last = self._pool.submit(self._run)

    def wait(self, timeout_s: float) -> bool:
        """Wait until all requested work is done; False on timeout."""
        return self._last is None or not wait_for([self._last], timeout_s).not_done

    def close(self) -> None:
        """Finish the work in progress and ignore later requests."""
        with self._asking:
            self._closed = True
        self._pool.shutdown(cancel_futures=True)

    def _run(self) -> None:
        try:
            self._work()
        except Exception:
            logging.getLogger("sarsplat").exception("the picture could not be drawn")
        self.done += 1
