"""Progress display of a sweep: how many runs have ended, and how far those under way are."""

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
from sarsplat.runs.run_folder import METRICS, POINTS, LogLine, RunFolder
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import RUNS

_EVERY_S = 10.0
_SHOWN = 2
"""Runs that are named at a time."""


class Live:
    """Shows the progress of runs while the block runs, at least every few seconds, from the files they write."""

    def __init__(self, cells: Sequence[Cell], out: Path, reporter: Reporter) -> None:
        self._left = {cell.address: cell for cell in cells}
        labels = {name for cell in cells for name in cell.labels}  # the dataset, and what is not the same everywhere
        differ = (n for n in labels if len({repr(cell.labels[n]) for cell in cells if n in cell.labels}) > 1)
        self._names = {"dataset", *differ}
        self._out, self._reporter, self._begun = out, reporter, time.time()
        self._over, self._one_at_a_time = threading.Event(), threading.Lock()
        self._failed = 0
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Live:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def ended(self, cell: Cell, failed: bool = False) -> None:
        with self._one_at_a_time:
            self._left.pop(cell.address, None)
            self._failed += failed
            self._reporter.advance(1, f"{cell.words(self._names)}: {'failed' if failed else 'done'}")

    def _watch(self) -> None:
        while not self._over.wait(_EVERY_S):
            with self._one_at_a_time:
                said = [f"{cell.words(self._names)}: {stage}" for cell, stage in self._stages()]
                failed = f", {self._failed} failed" if self._failed else ""
                counts = f"{len(said)} under way, {len(self._left) - len(said)} waiting{failed}"
                self._reporter.advance(0, "; ".join([counts, *said[:_SHOWN]]))

    def _stages(self) -> Iterator[tuple[Cell, str]]:
        """Runs that have written to their logs since this began, with what they are at."""
        for address, cell in self._left.items():
            run = self._out / RUNS / address
            for files in (RunFolder(run), RunFolder(temporary_folder(run))):
                with suppress(OSError, SarsplatError):  # it may be moved or replaced just now
                    if files.log_path.stat().st_mtime > self._begun and (lines := files.history):
                        yield cell, _stage(files, lines[-1], cell.config.get("iterations"))


def _stage(files: RunFolder, line: LogLine, planned: int | None) -> str:
    """What a run is at, by what it has written last."""
    if planned is None or line.iteration < planned:
        of = "" if planned is None else f" of {planned:,}"
        return f"training, {line.iteration:,}{of}, loss {line.loss:.3g}"
    if not (files.path / POINTS).is_file():
        return "extracting points"
    return "report" if (files.path / METRICS).is_file() else "scoring"
