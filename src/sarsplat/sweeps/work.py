"""One run of a sweep: train or resume it, score it, and write its row."""

import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import torch

from sarsplat.data import read_dataset, read_json, write_json
from sarsplat.data.files import locked
from sarsplat.data.folders import temporary_folder
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.evaluation import evaluate_run
from sarsplat.executors.executor import Work
from sarsplat.runs import Run, reconstruct
from sarsplat.runs.methods import method_named
from sarsplat.runs.run_folder import HEADER
from sarsplat.settings.record import dotted
from sarsplat.sweeps.cell import Cell

ROWS, RUNS = "rows", "runs"
"""Folders of a sweep."""

_lock = threading.Lock()
_lists: dict[int, list[str]] = {}  # messages of the block that each thread is in

_usual = ExitStack()  # restores the process's handling of warnings


class Row(msgspec.Struct):
    """The result row of a run."""

    address: str
    recipe: str
    code: str
    scoring: str
    """Digests from its `Cell`."""
    state: str
    """Either "finished" or "failed"."""
    reason: str = ""
    """Reason of a failure, one sentence."""
    passing: bool = False
    """True if the failure may pass, such as a full disk or GPU: the next sweep tries again."""
    scores: dict[str, float] = {}
    """Scores by dotted key, such as `images.test.psnr_db` and `points.visible.cd_m`, without None."""
    yardstick_m: float = 0.0
    """`Yardstick` of the points' scores, m."""
    iterations: int = 0
    """Iterations done."""
    took_s: float = 0.0
    """Time of training, scoring and report since the last start, s."""
    warnings: list[str] = []
    """Warnings of the run."""


def row_path(cell: Cell, out: Path) -> Path:
    return out / ROWS / f"{cell.address}.json"


def row_of(cell: Cell, out: Path) -> Row | None:
    """Row of a run; None if it is missing, outdated, or of a failure that may pass."""
    if not (path := row_path(cell, out)).is_file():
        return None
    row = read_json(path, Row)
    return None if row.passing or (row.address, row.scoring) != (cell.address, cell.scoring) else row


def do(cell: Cell, out: Path, again: bool = False) -> Row | None:
    """Do a run of the sweep in `out` unless it is done; None if another process is doing it.

    With `again`, a failed run is tried again.
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
            except Exception as error:  # a bug here or in a plugin, or no memory: other runs go on
                traceback.print_exc()
                row.state, row.reason, row.passing = "failed", f"{type(error).__name__}: {error}", True
        run = out / RUNS / cell.address
        for folder in (temporary_folder(run), run):  # its name is a hash, which means nothing to users
            row.reason = row.reason.replace(f"{folder}/", "").replace(str(folder), "the run")
        row.took_s = round(time.monotonic() - begun, 3)
        write_json(row_path(cell, out), row)
        return row


def lost(cell: Cell, out: Path, reason: str) -> Row | None:
    """Write the row of a run whose process has died; None if another process is doing it."""
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
    mesh = None if cell.mesh is None else Path(cell.mesh)
    metrics = evaluate_run(run, mesh=mesh, alignment=cell.align, masks=masks, quiet=True)  # type: ignore[arg-type]
    if cell.reports:
        from sarsplat.report import write_report

        write_report(run, quiet=True)
    scores = {name: metrics[name] for name in ("images", "points", "mesh", "baselines", "time_s")}
    row.scores = {name: value for name, value in dotted(scores) if value is not None}
    row.yardstick_m = metrics["parameters"]["yardstick_m"]
    row.iterations = run.iteration


@contextmanager
def caught() -> Iterator[list[str]]:
    """Collect this thread's `SarsplatWarning` messages while the block runs; other warnings are dropped.

    Unlike `warnings.catch_warnings`, blocks of several threads may overlap. Warnings of threads without a block (which
    libraries start) go to every block.
    """
    messages: list[str] = []
    with _lock:
        if not _lists:
            _usual.enter_context(warnings.catch_warnings())
        warnings.simplefilter("always", SarsplatWarning)  # anew: a library's own block may have put older filters back
        warnings.showwarning = _keep  # type: ignore[assignment]
        _lists[threading.get_ident()] = messages
    try:
        yield messages
    finally:
        with _lock:
            del _lists[threading.get_ident()]
            if not _lists:
                _usual.close()


def _keep(message: Warning | str, category: type[Warning], *place: object) -> None:
    if issubclass(category, SarsplatWarning):
        own = _lists.get(threading.get_ident())
        for messages in [*_lists.values()] if own is None else [own]:
            messages.append(str(message))


RUN = Work(Cell, Row, do, lost, "start the sweep again to continue it")
"""Work of executors: one run of a sweep."""
