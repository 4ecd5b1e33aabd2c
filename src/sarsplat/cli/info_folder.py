"""What `sarsplat info` says about a folder of datasets and runs: each with its state and its headline scores."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from sarsplat.cli import console
from sarsplat.errors import SarsplatError, counted

_DEEPEST = 3  # levels of folders below the one asked for
_DATASET, _RUN = "dataset.json", "config.json"


def describe_contents(path: Path) -> bool:
    """List the datasets and runs in a folder; False if there are none."""
    entries = sorted(_entries(path))
    if not entries:
        return False
    counts = Counter(marker for _, marker in entries)
    whole = (counted(counts[marker], noun) for marker, noun in ((_DATASET, "dataset"), (_RUN, "run")) if counts[marker])
    console.say(f"{path}: {' and '.join(whole)}")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for name in ("folder", "holds", "state", "scores"):
        table.add_column(name, overflow="fold")
    for folder, marker in entries:
        try:
            cells = _dataset(folder) if marker == _DATASET else _run(folder)
        except SarsplatError as error:
            cells = ("a dataset" if marker == _DATASET else "a run", f"unusable: {error}", "")
        table.add_row(escape(str(folder.relative_to(path))), *map(escape, cells))
    console.show(table)
    return True


def _entries(path: Path) -> Iterator[tuple[Path, str]]:
    """Folders of datasets and runs, each with the file that marks it; not what is inside of them."""
    for name, folders, files in os.walk(path):
        folder = Path(name)
        marker = next((marker for marker in (_DATASET, _RUN) if marker in files and _ours(folder / marker)), None)
        if marker is not None and folder != path:
            yield folder, marker
        if marker is not None or len(folder.relative_to(path).parts) == _DEEPEST:
            folders.clear()
        folders[:] = [inner for inner in folders if not inner.startswith(".")]


def _ours(header: Path) -> bool:
    """Whether sarsplat has written it: many programs have a `config.json`."""
    from sarsplat.data.files import open_file

    with open_file(header) as file:
        return b'"sarsplat-' in file.read(1000)


def _dataset(folder: Path) -> tuple[str, str, str]:
    from sarsplat.data.dataset_folder import read_header

    header = read_header(folder)
    sets = ", ".join(f"{number:,} {split}" for split, number in Counter(view.split for view in header.views).items())
    pixels = f"{header.grid.rows} × {header.grid.columns} pixels"
    return f"{counted(len(header.views), 'image')} of {header.target}", f"{sets}; {pixels}", ""


def _run(folder: Path) -> tuple[str, str, str]:
    from sarsplat.runs.run_folder import RunFolder

    files = RunFolder(folder)
    header = files.header
    learned_from = "images in memory" if header.dataset is None else Path(header.dataset).name
    return f"run of {learned_from} ({header.method})", str(files.state), _scores(files.metrics)


def _scores(metrics: Mapping[str, Any] | None) -> str:
    if metrics is None:
        return "not evaluated"
    from sarsplat.evaluation import Yardstick, all_metrics, comparison

    try:
        headed = [metric for metric in all_metrics(Yardstick(metrics["parameters"]["yardstick_m"])) if metric.short]
        values = comparison(metrics)[0].values
        headline = [metric for metric in headed if metric.place == "headline" and values.get(metric.key) is not None]
        return ", ".join(f"{one.short} {one.text(values[one.key])} {one.unit}".strip() for one in headline)
    except (KeyError, TypeError, AttributeError, ValueError):
        return "scores of another version; evaluate it again"
