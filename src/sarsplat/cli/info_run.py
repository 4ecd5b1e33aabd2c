"""`sarsplat info` of a run, or of a folder of datasets and runs: states, scores, next commands."""

from __future__ import annotations

import json
import math
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from sarsplat.cli import console
from sarsplat.cli.import_mstar import PLAN, SplitSource, rows_of_all
from sarsplat.errors import SarsplatError, counted

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.runs.run_folder import RunFolder, TrainingState

_DEEPEST = 3  # levels of folders below the one asked for
_DATASET, _RUN = "dataset.json", "config.json"


def describe_run(path: Path) -> None:
    """Print the properties of a run, without loading torch, or its model if it is unfinished."""
    from sarsplat.runs.run_folder import RunFolder, left_open
    from sarsplat.settings.config import OWN_LOOP

    files = RunFolder(path)
    header, state = files.header, files.state
    where = None if header.dataset is None else Path(header.dataset)
    about = _about(files) if state.has_results else _so_far(files, state)
    stored = files.points
    rows = {
        "dataset": "images in memory" if where is None else f"{where}{'' if where.exists() else ' (no longer there)'}",
        "method": header.method,
        "state": str(state),
        **({"place": str(header.place.place)} if header.place else {}),
        **about,
        "points": "none yet" if stored is None else extent(stored[0]),
        "scores": f"{_scores(files.metrics) or 'no test images, no true mesh'} (metrics.json)"
        if files.metrics
        else f"none yet; run sarsplat evaluate {shlex.quote(str(path))}",
        **left_open(files.metrics or {}),
        "report": "report/index.html" if (path / "report" / "index.html").is_file() else "none yet",
    }
    whole = path.absolute().parents[1] if len(path.absolute().parents) > 1 else path
    if path.absolute().parent.name == "tiles" and (whole / "config.json").is_file():
        console.facts(f"{path}: a tile of the run {whole}, which goes on with it", rows)
        return
    console.facts(f"{path}: a run", rows)
    console.warn_if_beaten(files.metrics)
    if not state.finished and (state.done or not state.has_results) and header.config.get("preset") != OWN_LOOP:
        dataset = "DATASET" if where is None or not where.exists() else shlex.quote(str(where))
        console.say(f"go on with: sarsplat reconstruct {dataset} --out {shlex.quote(str(path))} --resume")


def _about(files: RunFolder) -> dict[str, str]:
    """Return `Run.about` from its file, which runs of older versions lack."""
    from sarsplat.data import read_json
    from sarsplat.runs.run_folder import ABOUT

    if (files.path / ABOUT).is_file():
        return read_json(files.path / ABOUT, dict[str, str])
    from sarsplat.runs import Run

    return Run.load(files.path).about


def _so_far(files: RunFolder, state: TrainingState) -> dict[str, str]:
    """Return rows about an unfinished training from its settings and log."""
    settings = files.header.config
    rows: dict[str, str] = {name: str(settings[name]) for name in ("preset", "seed") if name in settings}
    last = next((line for line in reversed(files.history) if line.iteration <= state.done), None)
    if last is None:
        return rows
    if last.gaussians is not None:
        rows["learned"] = counted(last.gaussians, "Gaussian")
    return {**rows, "loss": f"{last.loss:.3g}", "time": f"{last.seconds:.1f} s"}


def extent(points: np.ndarray) -> str:
    """Return the number of points and the ranges of their coordinates."""
    if len(points) == 0:
        return "0"
    low, high = points.min(axis=0), points.max(axis=0)
    ranges = ", ".join(f"{name} {_between(float(a), float(b))} m" for name, a, b in zip("xyz", low, high, strict=True))
    return f"{len(points):,}; {ranges}"


def _between(low: float, high: float) -> str:
    """Return both ends, with more digits if their difference is small, as in map coordinates."""
    largest, difference = max(abs(low), abs(high)), high - low
    more = math.floor(math.log10(largest / difference)) if 0 < difference < largest else 0
    return f"{low:.{4 + more}g} … {high:.{4 + more}g}"


def describe_contents(path: Path) -> bool:
    """List the datasets and runs in a folder; False if there are none."""
    from sarsplat.runs.run_folder import is_hashed

    entries = sorted(_entries(path))
    if not entries:
        return False
    counts = Counter(marker for _, marker in entries)
    whole = (counted(counts[marker], noun) for marker, noun in ((_DATASET, "dataset"), (_RUN, "run")) if counts[marker])
    console.say(f"{path}: {' and '.join(whole)}")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    runs = _names_of_runs([folder for folder, marker in entries if marker == _RUN])
    rows: list[tuple[str, ...]] = []
    splits: dict[Path, list[SplitSource]] = {}
    for folder, marker in entries:
        try:
            if marker == _DATASET:
                cells, split = _dataset(folder)
                if split is not None:
                    splits.setdefault(folder.parent, []).append(split)
            else:
                cells = _run(folder, runs.get(folder, ""))
        except SarsplatError as error:
            cells = ("a dataset" if marker == _DATASET else "a run", f"unusable: {error}", "")
        rows.append((str(folder.relative_to(path)), *cells))
    columns = [0, 1, 2, 3]
    if all(marker == _RUN and is_hashed(folder) for folder, marker in entries):
        columns = [1, 2, 3, 0]  # folders' names last, which are there to be opened
        rows.sort(key=lambda row: row[1])
    for index in columns:
        table.add_column(("folder", "holds", "state", "scores")[index], overflow="fold")
    for row in rows:
        table.add_row(*(escape(row[index]) for index in columns))
    console.show(table)
    for parent, own in splits.items():
        console.facts(f"{parent}: standard splits of MSTAR", rows_of_all(own))
        if len(own) == sum(marker == _DATASET and folder.parent == parent for folder, marker in entries):
            made = _beside(parent, "measured")
            console.say(f"for a classifier: sarsplat chips --measured {shlex.quote(str(parent))} --out {made}")
    if (page := path / "index.html").is_file() and (path / "sweep.json").is_file():
        console.say(f"a sweep: open {page} in a browser")
    elif (plan := path / PLAN).is_file():
        console.say(
            f"{plan} is a plan to reconstruct all datasets: sarsplat sweep {shlex.quote(str(plan))} --out "
            f"{_beside(path, 'runs')}"
        )
    elif counts[_DATASET] > 1:
        parents = dict.fromkeys(folder.parent for folder, marker in entries if marker == _DATASET)
        console.say("to reconstruct and score all datasets, write these two lines to plan.toml:")
        console.say(f"  datasets = {json.dumps([f'{parent}/*' for parent in parents])}\n  seeds = [0, 1, 2]")
        console.say(f"and run: sarsplat sweep plan.toml --out {_beside(path, 'fleet')}")
    return True


def _beside(path: Path, what: str) -> str:
    """Return a folder name derived from another, quoted for a shell."""
    return shlex.quote(f"{path.resolve().name}-{what}")


def _entries(path: Path) -> Iterator[tuple[Path, str]]:
    """Yield folders of datasets and runs, each with its marker file; folders inside these are skipped."""
    for name, folders, files in os.walk(path):
        folder = Path(name)
        marker = next((marker for marker in (_DATASET, _RUN) if marker in files and _is_own(folder / marker)), None)
        if marker is not None and folder != path:
            yield folder, marker
        if marker is not None or len(folder.relative_to(path).parts) == _DEEPEST:
            folders.clear()
        folders[:] = [inner for inner in folders if not inner.startswith(".")]


def _is_own(header: Path) -> bool:
    """Return whether sarsplat has written the file: many programs have a `config.json`."""
    from sarsplat.data.files import open_file

    with open_file(header) as file:
        return b'"sarsplat-' in file.read(1000)


def _dataset(folder: Path) -> tuple[tuple[str, str, str], SplitSource | None]:
    from sarsplat.data.dataset_folder import read_header

    header = read_header(folder)
    split = SplitSource.of(header.target, header.source)
    sets = ", ".join(f"{number:,} {name}" for name, number in Counter(view.split for view in header.views).items())
    sets += f", {split.unplaced:,} unplaced" if split is not None and split.unplaced else ""
    pixels = f"{header.grid.rows} × {header.grid.columns} pixels"
    return (f"{counted(len(header.views), 'image')} of {header.target}", f"{sets}; {pixels}", ""), split


def _names_of_runs(folders: Sequence[Path]) -> dict[Path, str]:
    """Return names of the datasets of readable runs; for unnamed ones, their differing properties."""
    from sarsplat.runs.run_folder import distinguished, is_hashed, read_header

    headers = {}
    for folder in folders:
        with suppress(SarsplatError):  # its row shows the error
            headers[folder] = read_header(folder)
    nameless = {folder: header for folder, header in headers.items() if is_hashed(folder)}
    names = {folder: distinguished([header])[0] for folder, header in headers.items()}
    return names | dict(zip(nameless, distinguished([*nameless.values()], with_method=False), strict=True))


def _run(folder: Path, name: str) -> tuple[str, str, str]:
    from sarsplat.runs.run_folder import RunFolder

    files = RunFolder(folder)
    return f"run of {name} ({files.header.method})", str(files.state), _scores(files.metrics)


def _scores(metrics: Mapping[str, Any] | None) -> str:
    if metrics is None:
        return "not evaluated"
    from sarsplat.evaluation import Yardstick, all_metrics, beaten, comparison

    try:
        headed = [metric for metric in all_metrics(Yardstick(metrics["parameters"]["yardstick_m"])) if metric.short]
        values = comparison(metrics)[0].values
        headline = [metric for metric in headed if metric.place == "headline" and values.get(metric.key) is not None]
        scores = [f"{one.short} {one.text(values[one.key])} {one.unit}".strip() for one in headline]
        worse = (f"worse than {one.by} on {one.split}, {one.metric.text(one.best)}" for one in beaten(metrics))
        return "; ".join([", ".join(scores), *worse])
    except (KeyError, TypeError, AttributeError, ValueError):
        return "scores of another version; evaluate it again"
