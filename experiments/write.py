"""Turn finished runs into docs/results: for every experiment a page, two CSV files and a plot, and an index."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from catalogue import EXPERIMENTS
from draw import draw
from experiment import Experiment
from finding import findings
from finished import Finished, lines_of
from metrics import METRIC
from pictures import picture_of
from summary import Line, lines

from sarsplat.data import write_bytes
from sarsplat.evaluation.paper import NOT_THE_SAME_EXPERIMENT

_FOUND = "**Found.** "
_QUICK = "A quick run, which shows that everything works; its numbers mean nothing.\n\n"


def write(experiment: Experiment, runs: Sequence[Finished], out: Path) -> None:
    """Write one experiment as far as it is finished: what is missing is a dash, and without a row nothing is written.

    Parameters
    ----------
    experiment : Experiment
        Which.
    runs : sequence of Finished
        Its runs.
    out : pathlib.Path
        Folder of the results; made if missing.
    """
    finished = lines(experiment, runs)
    if not any(line.seeds for line in finished):
        return
    out.mkdir(parents=True, exist_ok=True)
    _write(out / f"{experiment.name}.csv", _csv(_summary_rows(finished)))
    _write(out / f"{experiment.name}-runs.csv", _csv(lines_of(runs)))
    begun = _begun(finished)
    draw(experiment, [line for line in finished if line.row.group in begun], out / f"{experiment.name}.png")
    _write(out / f"{experiment.name}.md", page(experiment, finished, runs, out))


def write_index(out: Path, quick: bool) -> None:
    """Write the first page: every experiment with what its page says, or that there is none yet."""
    out.mkdir(parents=True, exist_ok=True)
    parts = ["# Results\n\n", _QUICK if quick else "", "Written by `make tables`; do not edit.\n"]
    for experiment in EXPERIMENTS:
        path = out / f"{experiment.name}.md"
        if path.is_file():
            said = [text for text in path.read_text(encoding="utf-8").splitlines() if text.startswith(_FOUND)]
            parts.append(f"\n## [{experiment.title}]({path.name})\n")
            parts += [f"\n{text.removeprefix(_FOUND)}\n" for text in said]
        else:
            parts.append(f"\n## {experiment.title}\n\nNot run yet: `make tables ONLY={experiment.name}`.\n")
    _write(out / "README.md", "".join(parts))


def _begun(finished: Sequence[Line]) -> set[str]:
    """Groups of which a row is finished."""
    return {line.row.group for line in finished if line.seeds}


def page(experiment: Experiment, finished: list[Line], runs: Sequence[Finished], out: Path) -> str:
    """An experiment as Markdown: what was done, what it says, the table."""
    begun = _begun(finished)
    waiting = [group for group in experiment.groups() if group not in begun]
    finished = [line for line in finished if line.row.group in begun]
    experiment = replace(experiment, rows=tuple(row for row in experiment.rows if row.group in begun))
    codes = " and ".join(dict.fromkeys(filter(None, (run.about["code"] for run in runs)))) or "unknown"
    parts = [f"# {experiment.title}\n\n", _QUICK if experiment.quick else "", f"{experiment.about}\n\n"]
    parts += [f"Not run yet: {'; '.join(waiting)}.\n\n"] if waiting else []
    parts += [f"{_FOUND}{sentence}\n\n" for sentence in findings(experiment, finished)]
    for group in experiment.groups():
        members = [line for line in finished if line.row.group == group]
        parts += [f"## {group[0].upper()}{group[1:]}\n\n"] if group else []
        parts += [_table(columns, members) + "\n" for columns in experiment.tables]
        if (out / (picture := picture_of(experiment, group))).is_file():
            parts.append(f"![Two unseen images and the points of every method]({picture})\n\n")
    parts.append(
        f"![{experiment.title}]({experiment.name}.png)\n\n"
        "Mean ± sample standard deviation over the seeds that are finished; “–”: unknown, or not finished. Points "
        f"are held against the visible surface. Figures: [{experiment.name}.csv]({experiment.name}.csv); every run: "
        f"[{experiment.name}-runs.csv]({experiment.name}-runs.csv). "
        f"Written by `make tables` from code version {codes}.\n"
    )
    if any(line.row.paper for line in finished):
        parts.append(f"\n{NOT_THE_SAME_EXPERIMENT}\n")
    return "".join(parts)


def _table(columns: Sequence[str], finished: list[Line]) -> str:
    """Rows and metrics; where the paper has figures, a column of them beside ours."""
    heads, cells = (
        ["", "seeds"],
        [[line.row.label, f"{line.seeds}{', older code' if line.older else ''}"] for line in finished],
    )
    for key in columns:
        metric = METRIC[key]
        heads.append(f"{metric.title} {metric.arrow}".strip())
        for line, texts in zip(finished, cells, strict=True):
            texts.append(_text(key, line))
        if any(key in line.row.paper for line in finished):
            heads.append("paper")
            for line, texts in zip(finished, cells, strict=True):
                texts.append(metric.text(line.row.paper.get(key)))
    rows = [heads, ["---", *["---:"] * (len(heads) - 1)], *cells]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _text(key: str, line: Line) -> str:
    """Mean ± standard deviation, both with the mean's decimals."""
    spread = line.spreads.get(key)
    if spread is None:
        return "–"
    mean = METRIC[key].text(spread.mean)
    return mean if spread.sd is None else f"{mean} ± {spread.sd:.{len(mean.partition('.')[2])}f}"


def _summary_rows(finished: list[Line]) -> Iterable[Mapping[str, Any]]:
    """A line for every row and metric."""
    for line in finished:
        for key in dict.fromkeys((*line.spreads, *line.row.paper)):
            spread = line.spreads.get(key)
            yield {
                "group": line.row.group,
                "row": line.row.label,
                "x": line.row.x,
                "metric": key,
                "mean": None if spread is None else spread.mean,
                "sd": None if spread is None else spread.sd,
                "seeds": 0 if spread is None else len(spread.values),
                "paper": line.row.paper.get(key),
            }


def _csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as CSV; the columns are those of all rows, in order of first appearance."""
    listed = list(rows)
    file = io.StringIO()
    writer = csv.DictWriter(file, list(dict.fromkeys(name for row in listed for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(listed)
    return file.getvalue()


def _write(path: Path, text: str) -> None:
    write_bytes(path, text.encode())
