"""What the finished cells of a row say: mean over its datasets, spread over its seeds."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from catalogue import Experiment, Row
from cell import Cell

from sarsplat.evaluation import Metric, Yardstick, all_metrics
from sarsplat.scenes import paper_grid
from sarsplat.sweeps.results import Spread

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
    """

    row: Row
    spreads: Mapping[str, Spread]
    seeds: int


def read(cell: Cell, work: Path, code: str) -> dict[str, Any] | None:
    """A finished cell, or None."""
    path = cell.path(work, code)
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def scores(finished: Mapping[str, Any]) -> dict[str, float]:
    """The scores of one cell by key: unseen images, points against the visible surface, time; unknown ones absent."""
    images: dict[str, float | None] = {}
    for scored in finished["images"].values():
        images.update({key: value for key, value in scored.items() if value is not None})
    points = finished["points"]["visible"]
    cd_m, f1 = points["cd_m"], sorted((float(key[3:]), value) for key, value in points.items() if key.startswith("f1@"))
    cells = {
        "cd_cells": None if cd_m is None else cd_m / finished["cell_m"],
        "f1@cell": f1[-1][1],
        "f1@third": f1[0][1],
    }
    by_key = {**images, **points, **cells, "time_s": finished["time_s"]}
    return {key: float(value) for key, value in by_key.items() if value is not None}


def line(experiment: Experiment, row: Row, work: Path, code: str) -> Line:
    """One row with the figures of its finished cells."""
    seeds = []
    for seed in experiment.seeds:
        cells = [read(cell, work, code) for cell in experiment.cells(row, seed)]
        finished = [scores(cell) for cell in cells if cell is not None]
        if len(finished) == len(cells):
            seeds.append(finished)
    spreads = {}
    for key in experiment.columns:
        values = [
            statistics.fmean(cell[key] for cell in cells) for cells in seeds if all(key in cell for cell in cells)
        ]
        if values:
            spreads[key] = Spread(tuple(values))
    return Line(row, spreads, len(seeds))


def lines(experiment: Experiment, work: Path, code: str) -> list[Line]:
    """Every row with the figures of its finished cells."""
    return [line(experiment, row, work, code) for row in experiment.rows]
