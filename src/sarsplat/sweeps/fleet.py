"""Sweep: do the missing runs of a plan on an executor, show their progress, and write tables."""

import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from sarsplat.arguments import checks_arguments
from sarsplat.data import read_json, write_bytes, write_json
from sarsplat.data.files import locked, plain_os_errors
from sarsplat.data.folders import temporary_folder
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.executors.executor import Executor, Means, executor_named
from sarsplat.progress import Reporter, progress
from sarsplat.runs.run_folder import METRICS, POINTS, LogLine, RunFolder
from sarsplat.sweeps.cell import Cell, cells_of
from sarsplat.sweeps.page import page
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.results import Results, varying
from sarsplat.sweeps.work import ROWS, RUNS, row_of

HEADER, TABLE, PAGE = "sweep.json", "results.csv", "index.html"
_SCHEMA = "sarsplat-sweep"
_SHARE = 0.05  # maximum share of the time for writing results while runs go on
_PATIENCE_S = 2.0  # time between two checks of runs in other processes

_EVERY_S = 10.0
_SHOWN = 2  # maximum number of runs named at a time


@checks_arguments
def sweep(
    plan: Plan | str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    executor: str = "local",
    means: Means | None = None,
    device: str | None = None,
    shard: str | None = None,
    run: bool = True,
    quiet: bool = False,
) -> Results:
    """Do the missing runs of a plan, and write tables and a page of all runs.

    A run is identified by its data, its settings and the training's code, and is never done twice. A sweep can be
    stopped at any moment and started again; several processes can work on the same folder.

    Parameters
    ----------
    plan : Plan, str, Path or mapping
        A plan, its TOML file, or the content of such a file; datasets are searched below the file's folder, else below
        the current one.
    out : str or Path
        Folder of the sweep: `results.csv`, `index.html`, and a folder `runs` of the runs.
    executor : str
        "local", "ray", or another of `EXECUTORS`.
    means : Means, optional
        Resources that the executor may use.
    device : str, optional
        "cpu" or "cuda", instead of the plan's.
    shard : str, optional
        Only a share of the runs: ``"2/8"`` is the second of eight.
    run : bool
        Do the missing runs; otherwise only write tables and page.
    quiet : bool
        Show no progress.

    Returns
    -------
    Results
        All runs of the plan in the folder, including those of other shards.

    Raises
    ------
    SarsplatError
        If the plan is invalid, the executor is not available, or `out` holds something else. Errors of single runs are
        in their rows.
    """
    out, means, chosen = Path(out).resolve(), means or Means(), executor_named(executor)
    base = Path.cwd()
    if isinstance(plan, str | Path):
        base, plan = Path(plan).resolve().parent, Plan.read(Path(plan))
    elif isinstance(plan, Mapping):
        plan = Plan.from_dict(dict(plan), "the plan")
    cells = cells_of(plan if device is None else plan.on(device), base)
    if means.per_device is not None and all(cell.device != "cuda" for cell in cells):
        raise SarsplatError(
            f"per_device is {means.per_device}, but no run of the plan is on a GPU; leave it out, or give device cuda"
        )
    unique = {cell.address: cell for cell in _shard(cells, shard)}
    _prepare(out)
    todo = [cell for cell in unique.values() if (row := row_of(cell, out)) is None or (means.again and row.reason)]
    with progress("sweep", len(unique), quiet) as reporter:
        reporter.start_at(len(unique) - len(todo))
        if run:
            _run(todo, cells, out, chosen, means, reporter)
    return _write(cells, out, patient=True)


def _run(
    todo: Sequence[Cell], cells: Sequence[Cell], out: Path, executor: Executor, means: Means, reporter: Reporter
) -> None:
    """Do runs; wait for those that other processes are doing, and do them if these processes end before."""
    begun, writing_s, others = time.monotonic(), 0.0, False
    while todo:
        busy = []
        with Live(todo, out, reporter) as live, closing(executor(todo, out, means)) as outcomes:  # type: ignore[type-var]
            for cell, row in outcomes:
                if row is None:
                    busy.append(cell)
                    if not others:
                        reporter.note("another sweep works here, too: what it does is left to it, and waited for")
                        others = True
                    continue
                if row.state == "failed":
                    reporter.note(f"failed: {cell.words(cell.labels)}: {row.reason}")
                live.ended(cell, failed=row.state == "failed")
                if writing_s <= _SHARE * (now := time.monotonic() - begun):
                    _write(cells, out)
                    writing_s += time.monotonic() - begun - now
        if len(busy) == len(todo):
            reporter.advance(0, f"{counted(len(busy), 'run')} in other processes")
            time.sleep(_PATIENCE_S)
        todo = busy


def _shard(cells: Sequence[Cell], shard: str | None) -> Sequence[Cell]:
    if shard is None:
        return cells
    parts = re.fullmatch(r"(\d{1,9})/(\d{1,9})", shard)
    index, count = map(int, parts.groups()) if parts else (0, 0)
    if not 1 <= index <= count:
        raise SarsplatError(f"the shard is {shown(shard)}; give 1/8 for the first of eight, up to 8/8")
    return cells[index - 1 :: count]


def _prepare(out: Path) -> None:
    """Make the folder unless it exists; raise if it holds something else."""
    with plain_os_errors("write", out):
        if (out / HEADER).is_file():
            if read_json(out / HEADER, dict[str, Any]).get("schema") != _SCHEMA:
                raise SarsplatError(f"{out / HEADER} is not of a sweep; choose another name")
        elif out.exists() and (not out.is_dir() or any(one for one in out.iterdir() if not one.name.startswith("."))):
            raise SarsplatError(f"{out} exists and is not the folder of a sweep; choose another name")
        for folder in (ROWS, RUNS):
            (out / folder).mkdir(parents=True, exist_ok=True)
        if not (out / HEADER).is_file():
            write_json(out / HEADER, {"schema": _SCHEMA, "schema_version": 1})


def _write(cells: Sequence[Cell], out: Path, patient: bool = False) -> Results:
    """Write table and page; if another process is writing them, wait if `patient`, else leave it to that process."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(locked(out / TABLE))
                break
            except SarsplatError:
                if not patient:
                    return Results(cells, out)
            time.sleep(_PATIENCE_S / 10)
        results = Results(cells, out)
        write_bytes(out / TABLE, results.csv().encode())
        write_bytes(out / PAGE, page(results).encode())
    return results


# ---- progress --------------------------------------------------------------------------------------------------------
class Live:
    """Shows the progress of runs every few seconds while the block runs, from the files that they write."""

    def __init__(self, cells: Sequence[Cell], out: Path, reporter: Reporter) -> None:
        self._left = {cell.address: cell for cell in cells}
        self._names = varying(cells)
        self._out, self._reporter, self._begun = out, reporter, time.time()
        self._over, self._one_at_a_time = threading.Event(), threading.Lock()
        self._failed = 0
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Live":
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
                running = [f"{cell.words(self._names)}: {stage}" for cell, stage in self._stages()]
                failed = f", {self._failed} failed" if self._failed else ""
                counts = f"{len(running)} under way, {len(self._left) - len(running)} waiting{failed}"
                self._reporter.advance(0, "; ".join([counts, *running[:_SHOWN]]))

    def _stages(self) -> Iterator[tuple[Cell, str]]:
        """Runs that have written to their logs since the block began, with their stages."""
        for address, cell in self._left.items():
            run = self._out / RUNS / address
            for files in (RunFolder(run), RunFolder(temporary_folder(run))):
                with suppress(OSError, SarsplatError):  # the folder may be moved or replaced meanwhile
                    if files.log_path.stat().st_mtime > self._begun and (lines := files.history):
                        yield cell, _stage(files, lines[-1], cell.config.get("iterations"))


def _stage(files: RunFolder, line: LogLine, planned: int | None) -> str:
    """Stage of a run by the last file that it has written."""
    if planned is None or line.iteration < planned:
        of = "" if planned is None else f" of {planned:,}"
        return f"training, {line.iteration:,}{of}, loss {line.loss:.3g}"
    if not (files.path / POINTS).is_file():
        return "extracting points"
    return "report" if (files.path / METRICS).is_file() else "scoring"
