"""Progress display of a sweep: which runs have ended, and how far the others are."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from sarsplat.data.folders import temporary_folder
from sarsplat.errors import SarsplatError
from sarsplat.progress import Reporter
from sarsplat.runs.run_folder import LogLine, RunFolder
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import RUNS

_EVERY_S = 10.0
_SHOWN = 2
"""Runs that are named at a time."""


class Live:
    """Shows the progress of runs while the block runs, at least every few seconds, from the logs they write."""

    def __init__(self, cells: Sequence[Cell], out: Path, reporter: Reporter) -> None:
        self._left = {cell.address: cell for cell in cells}
        labels = {name for cell in cells for name in cell.labels}  # the dataset, and what is not the same everywhere
        self._names = {n for n in labels if len({repr(cell.labels.get(n)) for cell in cells}) > 1} | {"dataset"}
        self._out, self._reporter, self._begun = out, reporter, time.time()
        self._over, self._one_at_a_time = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Live:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def ended(self, cell: Cell) -> None:
        with self._one_at_a_time:
            self._left.pop(cell.address, None)
            self._reporter.advance(1, cell.words(self._names))

    def _watch(self) -> None:
        while not self._over.wait(_EVERY_S):
            with self._one_at_a_time:
                said = [
                    f"{cell.words(self._names)} at {line.iteration}, loss {line.loss:.3g}"
                    for cell, line in self._logs()
                ]
                more = f" and {len(said) - _SHOWN} more" if len(said) > _SHOWN else ""
                self._reporter.advance(0, "; ".join(said[:_SHOWN]) + more if said else "running")

    def _logs(self) -> Iterator[tuple[Cell, LogLine]]:
        """Runs that have written to their logs since this began, with the last line."""
        for address, cell in self._left.items():
            run = self._out / RUNS / address
            for files in (RunFolder(run), RunFolder(temporary_folder(run))):
                with suppress(OSError, SarsplatError):  # it may be moved or replaced just now
                    if files.log_path.stat().st_mtime > self._begun and (lines := files.history):
                        yield cell, lines[-1]
