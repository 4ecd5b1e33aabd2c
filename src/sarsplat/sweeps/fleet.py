"""Do a plan: what is missing of it, by any executor, and what has been found as it goes on."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from sarsplat.arguments import checks_arguments
from sarsplat.data import read_json, write_bytes, write_json
from sarsplat.data.files import locked, plain_os_errors
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.executors.executor import Executor, Means, executor_named
from sarsplat.progress import Reporter, progress
from sarsplat.sweeps.cell import Cell, cells_of
from sarsplat.sweeps.page import page
from sarsplat.sweeps.plan import Plan
from sarsplat.sweeps.results import Results
from sarsplat.sweeps.under_way import Live
from sarsplat.sweeps.work import ROWS, RUNS, row_of

HEADER, TABLE, PAGE = "sweep.json", "results.csv", "index.html"
_SCHEMA = "sarsplat-sweep"
_SHARE = 0.05
"""Of the time may go into writing results while runs go on."""

_PATIENCE_S = 2.0
"""Between two looks at runs that other processes are doing."""


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
    """Do every run of a plan that has not been done, and write tables and a page of all of them.

    A run is known by its data, its settings and the code that training takes: the same is never done twice, and what
    differs in any of them is another one. It can be ended at any moment and started again; several can work on the
    same folder.

    Parameters
    ----------
    plan : Plan, str, Path or mapping
        What to do: a plan, its TOML file, or what such a file would hold; datasets are sought below the file's folder,
        else below the current one.
    out : str or Path
        Folder of the sweep: `results.csv`, `index.html`, and a folder `runs` of the runs.
    executor : str
        Who does it: "local", "ray", or another of `EXECUTORS`.
    means : Means, optional
        What the executor may use.
    device : str, optional
        "cpu" or "cuda", instead of what the plan says.
    shard : str, optional
        Only a share of the runs: ``"2/8"`` is the second of eight.
    run : bool
        Whether to do what is missing; otherwise only tables and page are written.
    quiet : bool
        Show no progress.

    Returns
    -------
    Results
        All runs of the plan as they are in the folder, those of other shards included.

    Raises
    ------
    SarsplatError
        If the plan is not one, names what does not exist, the executor cannot be had, or `out` holds something else.
        What fails in a single run is in its row.
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
    mine = _shard(cells, shard)
    _prepare(out)
    unique = {cell.address: cell for cell in mine}
    todo = [cell for cell in unique.values() if (row := row_of(cell, out)) is None or (means.again and row.reason)]
    with progress("sweep", len(unique), quiet) as reporter:
        reporter.start_at(len(unique) - len(todo))
        if run:
            _run(todo, cells, out, chosen, means, reporter)
    return _write(cells, out, patient=True)


def _run(
    todo: Sequence[Cell], cells: Sequence[Cell], out: Path, executor: Executor, means: Means, reporter: Reporter
) -> None:
    """Do what is to be done; what other processes are doing is waited for, or done if they end before."""
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
    """Make the folder, unless it is there; refused if it holds something else."""
    with plain_os_errors("write", out):
        if (out / HEADER).is_file():
            if read_json(out / HEADER, dict[str, Any]).get("schema") != _SCHEMA:
                raise SarsplatError(f"{out / HEADER} is not that of a sweep; choose another name")
        elif out.exists() and (not out.is_dir() or any(one for one in out.iterdir() if not one.name.startswith("."))):
            raise SarsplatError(f"{out} exists and is not the folder of a sweep; choose another name")
        for folder in (ROWS, RUNS):
            (out / folder).mkdir(parents=True, exist_ok=True)
        if not (out / HEADER).is_file():
            write_json(out / HEADER, {"schema": _SCHEMA, "schema_version": 1})


def _write(cells: Sequence[Cell], out: Path, patient: bool = False) -> Results:
    """Write table and page of what is known; if another process is at it, wait for it, or leave it to that one."""
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
