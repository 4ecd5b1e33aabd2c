"""Do one run of a sweep: train, or go on where it was stopped, score it, and leave its row."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import torch

from sarsplat.data import read_dataset, read_json, write_json
from sarsplat.data.files import locked
from sarsplat.data.folders import temporary_folder
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import evaluate_run
from sarsplat.executors.executor import Work
from sarsplat.runs import Run, reconstruct
from sarsplat.runs.methods import method_named
from sarsplat.runs.run_folder import HEADER
from sarsplat.sweeps.caught import caught
from sarsplat.sweeps.cell import Cell

ROWS, RUNS = "rows", "runs"
"""Folders of a sweep."""


class Row(msgspec.Struct):
    """The result row of a run."""

    address: str
    recipe: str
    code: str
    scoring: str
    """As of its `Cell`."""
    state: str
    """Whether there are scores."""
    reason: str = ""
    """Why it failed: one sentence."""
    passing: bool = False
    """Whether it failed for what may pass, such as a full disk or GPU: it is tried again by the next sweep."""
    scores: dict[str, float] = {}
    """Scores by dotted key, as `images.test.psnr_db` and `points.visible.cd_m`; those that are None are absent."""
    yardstick_m: float = 0.0
    """What the points were scored with."""
    iterations: int = 0
    """Iterations done."""
    took_s: float = 0.0
    """Time of training, scoring and report, s, since it was last begun."""
    warnings: list[str] = []
    """What was warned of."""


def row_path(cell: Cell, out: Path) -> Path:
    return out / ROWS / f"{cell.address}.json"


def row_of(cell: Cell, out: Path) -> Row | None:
    """The row of a run, if it is finished or failed."""
    if not (path := row_path(cell, out)).is_file():
        return None
    row = read_json(path, Row)
    return None if row.passing or (row.address, row.scoring) != (cell.address, cell.scoring) else row


def do(cell: Cell, out: Path, again: bool = False) -> Row | None:
    """Do a run of the sweep in `out` unless that was done; None if another process is doing it.

    A failed one is tried `again` only if that is asked for.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(row_path(cell, out)))
        except SarsplatError:
            return None
        done = row_of(cell, out)
        if done is not None and not (again and done.state == "failed"):
            return done
        row, begun = Row(cell.address, cell.recipe, cell.code, cell.scoring, "finished"), time.monotonic()
        with caught() as row.warnings:
            try:
                _train_and_score(cell, out / RUNS / cell.address, row)
            except SarsplatError as error:
                passing = isinstance(error.__cause__, OSError | torch.OutOfMemoryError)
                row.state, row.reason, row.passing = "failed", str(error), passing
            except ModuleNotFoundError as error:
                row.state, row.reason, row.passing = "failed", f"{error.name} is not installed; install it", True
            except Exception as error:  # a fault of ours or of a plugin, or no memory: the others go on
                traceback.print_exc()
                row.state, row.reason, row.passing = "failed", f"{type(error).__name__}: {error}", True
        row.reason = _without_folder(row.reason, out / RUNS / cell.address)
        row.took_s = round(time.monotonic() - begun, 3)
        write_json(row_path(cell, out), row)
        return row


def lost(cell: Cell, out: Path, reason: str) -> Row | None:
    """Leave the row of a run whose process has ended; None if another process is doing it."""
    row = Row(cell.address, cell.recipe, cell.code, cell.scoring, "failed", reason, passing=True)
    try:
        with locked(row_path(cell, out)):
            write_json(row_path(cell, out), row)
    except SarsplatError:
        return None
    return row


def _train_and_score(cell: Cell, folder: Path, row: Row) -> None:
    torch.set_num_threads(1)
    dataset, method = read_dataset(Path(cell.dataset)), method_named(cell.method)
    if dataset.fingerprint() != cell.fingerprint:
        raise SarsplatError(f"{cell.dataset} has changed since the sweep was started; start it again")
    config = method.settings.from_dict(cell.config)
    begun = (folder / HEADER).is_file()
    masks = None if cell.masks is None else Path(cell.masks)
    run = Run.load(folder, cell.device, dataset) if begun else None
    if run is None or run.iteration < config.iterations or not (folder / "points.ply").is_file():
        learned_from = masks if "masks" in method.takes and not begun else None
        run = reconstruct(
            dataset,
            config,
            folder,
            method=cell.method,
            masks=learned_from,
            device=cell.device,
            quiet=True,
            resume=begun,
        )
    mesh, align = None if cell.mesh is None else Path(cell.mesh), cell.align
    metrics = evaluate_run(run, mesh=mesh, alignment=align, masks=masks, quiet=True)  # type: ignore[arg-type]
    if cell.reports:
        from sarsplat.report import write_report

        write_report(run, quiet=True)
    row.scores, row.yardstick_m = scores_in(metrics), metrics["parameters"]["yardstick_m"]
    row.iterations = run.iteration


def _without_folder(reason: str, run: Path) -> str:
    """A reason without the run's folder, of which nobody knows the name: tables say which run it is of."""
    for folder in (temporary_folder(run), run):
        reason = reason.replace(f"{folder}/", "").replace(str(folder), "the run")
    return reason


def scores_in(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The scores of a `metrics.json` by dotted key, without those that are None."""
    kept = {name: metrics[name] for name in ("images", "points", "mesh", "baselines", "time_s")}
    return {name: value for name, value in _flat(kept) if value is not None}


def _flat(values: Mapping[str, Any], before: str = "") -> list[tuple[str, float | None]]:
    flat: list[tuple[str, float | None]] = []
    for name, value in values.items():
        flat += _flat(value, f"{before}{name}.") if isinstance(value, Mapping) else [(f"{before}{name}", value)]
    return flat


RUN = Work(Cell, Row, do, lost, "start the sweep again to continue it")
"""A run of a sweep, as work of an executor."""
