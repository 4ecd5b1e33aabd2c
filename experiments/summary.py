"""What the finished runs of a row say: mean over its datasets, spread over its seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from experiment import Experiment, Row
from finished import Finished

from sarsplat.sweeps.results import Spread


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


def line(experiment: Experiment, row: Row, runs: Sequence[Finished]) -> Line:
    """One row with the figures of its finished runs."""
    seeds, older = [], False
    for seed in experiment.seeds_of(row):
        finished = [run for run in runs if (run.row, run.seed) == (row.name, seed)]
        if len(finished) == len(row.datasets):
            seeds.append([run.scores for run in finished])
            older |= any(run.older for run in finished)
    spreads = {}
    for key in experiment.columns:
        values = [statistics.fmean(one[key] for one in several) for several in seeds if all(key in s for s in several)]
        if values:
            spreads[key] = Spread(tuple(values))
    return Line(row, spreads, len(seeds), older)


def lines(experiment: Experiment, runs: Sequence[Finished]) -> list[Line]:
    """Every row with the figures of its finished runs."""
    return [line(experiment, row, runs) for row in experiment.rows]
