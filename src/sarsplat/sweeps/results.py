"""Results of a sweep so far: a row for every run, and means with their spread over the seeds."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from sarsplat.data import read_json
from sarsplat.errors import SarsplatError, counted
from sarsplat.evaluation import Beaten, Metric, Scores, Yardstick, beaten, summary_metrics
from sarsplat.samples.encoding import encoded_table
from sarsplat.sweeps.cell import Cell
from sarsplat.sweeps.work import ROWS, RUNS, Row


@dataclass(frozen=True)
class Result:
    """Run of the plan with its result.

    Attributes
    ----------
    cell : Cell
        The run.
    row : Row or None
        Its result, if there is any yet.
    older : bool
        The row is of the same data and settings, but of older code or other scoring.
    """

    cell: Cell
    row: Row | None
    older: bool = False

    @property
    def finished(self) -> bool:
        """True if the run has scores."""
        return self.row is not None and self.row.state == "finished"

    @property
    def reason(self) -> str:
        """Reason of a failure, or ""."""
        return "" if self.row is None else self.row.reason

    @property
    def state(self) -> str:
        """State of the run in one or two words."""
        return "waiting" if self.row is None else f"{self.row.state}{', older code' if self.older else ''}"

    @property
    def beaten(self) -> list[Beaten]:
        """Test sets on which a baseline is better, if the run is finished."""
        return beaten(self.scored) if self.finished else []

    @property
    def scored(self) -> dict[str, dict[str, Any]]:
        """Scores of images by test set, and of baselines by test set and baseline."""
        nested: dict[str, dict[str, Any]] = {"images": {}, "baselines": {}}
        for name, value in (self.row.scores if self.row else {}).items():
            *parts, key = name.split(".")
            if parts and parts[0] in nested:
                inner: dict[str, Any] = nested
                for part in parts:
                    inner = inner.setdefault(part, {})
                inner[key] = value
        return nested


@dataclass(frozen=True)
class Spread:
    """Values of one score over the seeds, at least one."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        return statistics.fmean(self.values)

    @property
    def sd(self) -> float | None:
        """Sample standard deviation over the seeds; None for a single one."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    def text(self, metric: Metric[Any]) -> str:
        """Mean ± standard deviation, both with the mean's decimals."""
        mean = metric.text(self.mean)
        return mean if self.sd is None else f"{mean} ± {self.sd:.{len(mean.partition('.')[2])}f}"


@dataclass(frozen=True)
class Line:
    """Runs that differ only in the seed, on one test set; or a baseline."""

    labels: Mapping[str, Any]
    """Labels in tables; with several test sets, they include the set."""
    spreads: Mapping[str, Spread]
    """Known scores by the metric's key."""
    done: int
    of: int
    """Number of finished and of all runs; 0 for a baseline."""
    older: bool
    """True if some runs are of older code."""
    beaten: int = 0
    """Runs that are worse than a baseline."""

    def texts(self, names: Sequence[str], metrics: Sequence[Metric[Any]]) -> list[str]:
        """Cells of a table's row: labels of these names, runs, and scores."""
        worse = f", {self.beaten} worse than a baseline" if self.beaten else ""
        runs = f"{self.done}/{self.of}{', older code' if self.older else ''}{worse}" if self.of else "–"
        spreads = ((self.spreads.get(metric.key), metric) for metric in metrics)
        scores = ("–" if spread is None else spread.text(metric) for spread, metric in spreads)
        return [*(label_text(self.labels.get(name, "")) for name in names), runs, *scores]


class Results:
    """Runs of a sweep with their present results.

    Parameters
    ----------
    cells : sequence of Cell
        Runs of the plan.
    out : Path
        Folder of the sweep.
    """

    def __init__(self, cells: Sequence[Cell], out: Path) -> None:
        self.out = out
        rows = [*_rows(out)]
        current = {row.address: row for row in rows}
        older = {row.recipe: row for row in rows if row.state == "finished"}
        found = ((cell, current.get(cell.address) or older.get(cell.recipe)) for cell in cells)
        self.results = [
            Result(cell, row, row is not None and (row.address, row.scoring) != (cell.address, cell.scoring))
            for cell, row in found
        ]

    @property
    def failed(self) -> list[Result]:
        """Runs that failed."""
        return [one for one in self.results if one.row is not None and one.row.state == "failed"]

    def lines(self) -> list[Line]:
        """One line for each group of runs that differ only in the seed, and for each test set."""
        groups: dict[str, list[Result]] = {}
        for one in self.results:
            groups.setdefault(repr(one.cell.labels), []).append(one)
        sets = self._sets
        return [_line(group, split, len(sets) > 1) for group in groups.values() for split in sets or [""]]

    def baselines(self) -> list[Line]:
        """One line for each two-dimensional baseline, dataset and test set."""
        lines: dict[tuple[str, str, str], Line] = {}
        for one in self.results:
            for split, methods in one.scored["baselines"].items() if one.finished else ():
                for method, scores in methods.items():
                    labels = {"dataset": one.cell.labels["dataset"], "method": method.replace("_", " ")}
                    labels |= {"test set": split} if len(self._sets) > 1 else {}
                    spreads = {key: Spread((value,)) for key, value in scores.items()}
                    lines.setdefault((labels["dataset"], split, method), Line(labels, spreads, 0, 0, False))
        return [*lines.values()]

    def called(self, one: Result) -> str:
        """Description of a run by its dataset, its varying labels and its seed."""
        return one.cell.words(varying(self.lines()))

    @property
    def beaten(self) -> str | None:
        """Sentence with the worst run if any is worse than a two-dimensional baseline, else None."""
        found = [(one, where) for one in self.results for where in one.beaten]
        if not found:
            return None
        runs, done = len({id(one) for one, _ in found}), sum(one.finished for one in self.results)
        one, where = max(found, key=lambda each: abs(each[1].best - (each[1].own or 0.0)))
        return (
            f"{runs} of {counted(done, 'finished run')} {'is' if runs == 1 else 'are'} worse than a baseline, which "
            f"knows no third dimension; farthest {self.called(one)}, on the set {where.split}: {where.by} "
            f"{where.figures} ({where.metric.title})"
        )

    @property
    def _sets(self) -> list[str]:
        return [*dict.fromkeys(split for one in self.results if one.finished for split in one.scored["images"])]

    def columns(self) -> tuple[list[str], list[Metric[Any]]]:
        """Columns of tables of all lines: labels, and summary metrics that any line has."""
        lines, others = self.lines(), self.baselines()
        names = varying(lines)
        if others and "method" not in names:
            names.insert(names.index("dataset") + 1, "method")
        sides = sorted({one.row.yardstick_m for one in self.results if one.row is not None and one.finished})
        scores = [Scores("", {key: spread.mean for key, spread in line.spreads.items()}) for line in (*lines, *others)]
        found = {one.key: one for side in sides for one in summary_metrics(scores, Yardstick(side))}
        return names, [*found.values()]

    def table(self) -> Table:
        """Table of all lines with mean ± standard deviation over the seeds, for the terminal."""
        names, shown = self.columns()
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        for name in names:
            table.add_column(escape(name), overflow="fold")
        table.add_column("runs", justify="right")
        for metric in shown:
            table.add_column(metric.heading, justify="right")
        for lines in (self.lines(), self.baselines()):
            for line in lines:
                table.add_row(*map(escape, line.texts(names, shown)))
            table.add_section()
        return table

    def csv(self) -> str:
        """CSV with a line for every run: labels, seed, state, and every score by dotted key."""
        rows = []
        for one in self.results:
            cell, row = one.cell, one.row
            done = {} if row is None else {"iterations_done": row.iterations, "took_s": row.took_s, **row.scores}
            rows.append(
                {
                    **cell.labels,
                    "seed": cell.seed,
                    "state": one.state,
                    "reason": one.reason,
                    "beaten_by": "; ".join(f"{where.by} on {where.split}" for where in one.beaten),
                    "code": cell.code if row is None else row.code,
                    "run": "" if row is None else f"{RUNS}/{row.address}",
                    **done,
                }
            )
        return encoded_table(rows, list(dict.fromkeys(name for row in rows for name in row))).decode()


def varying(lines: Sequence[Line | Cell]) -> list[str]:
    """Names of labels that tables need: the dataset, and those with more than one value."""
    names = dict.fromkeys(name for line in lines for name in line.labels)
    return [n for n in names if n == "dataset" or len({repr(line.labels[n]) for line in lines if n in line.labels}) > 1]


def label_text(value: Any) -> str:
    """Text of a label's value in tables."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _rows(out: Path) -> Iterable[Row]:
    for path in sorted((out / ROWS).glob("*.json"), key=lambda path: (path.stat().st_mtime, path.name)):
        try:
            yield read_json(path, Row)
        except SarsplatError:  # of another version, or being replaced
            continue


def _line(group: Sequence[Result], split: str, several: bool) -> Line:
    finished = [one for one in group if one.finished]
    values: dict[str, list[float]] = {}
    for one in finished:
        for name, value in (one.row.scores if one.row else {}).items():
            for before in (f"images.{split}.", "points.visible.", "time_s"):
                if name.startswith(before):
                    values.setdefault(name.removeprefix(before) or name, []).append(value)
    labels = {**group[0].cell.labels, **({"test set": split} if several else {})}
    spreads = {name: Spread(tuple(many)) for name, many in values.items()}
    worse = sum(where.split == split for one in finished for where in one.beaten)
    return Line(labels, spreads, len(finished), len(group), any(one.older for one in finished), worse)
