"""What the finished runs of a row say: mean over its datasets, spread over its seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from catalogue import Experiment, Row

from sarsplat.evaluation import Metric, Yardstick, all_metrics
from sarsplat.scenes import paper_grid
from sarsplat.sweeps import work as sweeps
from sarsplat.sweeps.results import Result, Spread

METRIC: dict[str, Metric[Any]] = {metric.key: metric for metric in all_metrics(Yardstick.of(paper_grid()))}
METRIC |= {
    "cd_cells": replace(METRIC["cd_m"], key="cd_cells", unit="cells"),
    "f1@cell": replace(METRIC["f1@0.3"], key="f1@cell", label="F1 at a cell"),
    "f1@third": replace(METRIC["f1@0.1"], key="f1@third", label="F1 at a third of a cell"),
}
"""By key: those of the evaluation, and the points' scores in resolution cells, to compare targets of any size."""


@dataclass(frozen=True)
class Line:
    """One row with its figures so far.

    Attributes
    ----------
    row : Row
        What was done.
    spreads : mapping of str to Spread
        By key of the metric; unknown ones are absent.
    seeds : int
        Seeds of which every dataset is finished; the others do not count, or a mean would be one of other targets.
    older : bool
        Whether some of them are of older code.
    """

    row: Row
    spreads: Mapping[str, Spread]
    seeds: int
    older: bool = False


def scores(finished: sweeps.Row) -> dict[str, float]:
    """The scores of one run by key: unseen images, points against the visible surface, time; unknown ones absent."""
    by_key = {}
    for name, value in finished.scores.items():
        kind, _, rest = name.partition(".")
        if kind in ("images", "time_s") or name.startswith("points.visible."):
            by_key[rest.partition(".")[2] or name] = value
    f1 = sorted((float(key[3:]), value) for key, value in by_key.items() if key.startswith("f1@"))
    cells = {"cd_cells": by_key["cd_m"] / finished.yardstick_m} if "cd_m" in by_key else {}
    return by_key | cells | ({"f1@cell": f1[-1][1], "f1@third": f1[0][1]} if f1 else {})


def line(experiment: Experiment, row: Row, results: Sequence[Result]) -> Line:
    """One row with the figures of its finished runs."""
    seeds, older = [], False
    for seed in experiment.seeds:
        runs = [one for one in results if (one.cell.labels["part"], one.cell.seed) == (row.name, seed)]
        finished = [scores(one.row) for one in runs if one.finished and one.row is not None]
        if finished and len(finished) == len(runs):
            seeds.append(finished)
            older |= any(one.older for one in runs)
    spreads = {}
    for key in experiment.columns:
        values = [statistics.fmean(run[key] for run in runs) for runs in seeds if all(key in run for run in runs)]
        if values:
            spreads[key] = Spread(tuple(values))
    return Line(row, spreads, len(seeds), older)


def lines(experiment: Experiment, results: Sequence[Result]) -> list[Line]:
    """Every row with the figures of its finished runs."""
    return [line(experiment, row, results) for row in experiment.rows]
