"""Finished runs of an experiment: those of the sweep and, where there are none, those that the results kept."""

from __future__ import annotations

import csv
import shlex
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiment import Experiment, Row
from metrics import METRIC

from sarsplat.sweeps import work as sweeps
from sarsplat.sweeps.cell import code_of
from sarsplat.sweeps.results import Result

_ABOUT = ("group", "row", "seed", "dataset", "preset", "changes", "took_s", "code")
"""Columns that are no scores."""


@dataclass(frozen=True)
class Finished:
    """A run.

    Attributes
    ----------
    row : str
        Name of its row.
    seed : int
        Of its training.
    scores : mapping of str to float
        By key of the metric; unknown ones are absent.
    about : mapping of str to str
        The other columns of the file that keeps it.
    older : bool
        Whether it is of older code.
    """

    row: str
    seed: int
    scores: Mapping[str, float]
    about: Mapping[str, Any]
    older: bool = False


def runs_of(experiment: Experiment, results: Sequence[Result], kept: Path) -> list[Finished]:
    """Row after row and seed after seed; of a seed whose runs are not all there, those that the file `kept` holds.

    Parameters
    ----------
    experiment : Experiment
        Which.
    results : sequence of Result
        Of its sweep, as far as there are any.
    kept : pathlib.Path
        The file that `write` has made of it before.
    """
    before = _kept(kept)
    found: list[Finished] = []
    for row in experiment.rows:
        for seed in experiment.seeds_of(row):
            cells = [one for one in results if (one.cell.labels["part"], one.cell.seed) == (row.name, seed)]
            new = [_finished(row, one, dataset) for one, dataset in zip(cells, row.drawn(seed)) if one.finished]
            old = before.get((row.name, seed), [])
            if len(new) == len(row.datasets) or not old:
                found += new
            else:
                now = code_of(row.method, "cpu")
                found += [replace(run, older=run.about["code"] != now) for run in old]
    return found


def lines_of(runs: Iterable[Finished]) -> Iterable[Mapping[str, Any]]:
    """Of the file that keeps them."""
    for run in runs:
        yield {**{name: run.about.get(name, "") for name in _ABOUT}, **run.scores}


def scores(finished: sweeps.Row, row: Row) -> dict[str, float]:
    """The scores of one run by key: unseen images, points against the visible surface, time; unknown ones absent."""
    images: dict[str, list[float]] = {}
    by_key: dict[str, float] = {}
    for name, value in finished.scores.items():
        if row.scored and name.startswith(row.scored):
            images.setdefault(name.removeprefix(row.scored), []).append(value)
        elif not row.scored and name.startswith("images."):
            images.setdefault(name.split(".", 2)[2], []).append(value)
        elif (name == "time_s" or name.startswith("points.visible.")) and not row.scored.startswith("baselines."):
            by_key[name.removeprefix("points.visible.")] = value
    f1 = sorted((float(key[3:]), value) for key, value in by_key.items() if key.startswith("f1@"))
    cells = {"cd_cells": by_key["cd_m"] / finished.yardstick_m} if "cd_m" in by_key else {}
    by_key |= cells | ({"f1@cell": f1[-1][1], "f1@third": f1[0][1]} if f1 else {})
    return {key: statistics.fmean(values) for key, values in images.items()} | by_key


def _finished(row: Row, one: Result, dataset: Mapping[str, Any]) -> Finished:
    assert one.row is not None
    about = {
        "group": row.group,
        "row": row.label,
        "seed": one.cell.seed,
        "dataset": _options(dataset),
        "preset": one.cell.config.get("preset", ""),
        "changes": _options(row.changes),
        "took_s": one.row.took_s,
        "code": one.row.code,
    }
    known = {key: value for key, value in scores(one.row, row).items() if key in METRIC}
    return Finished(row.name, one.cell.seed, known, about, one.older)


def _kept(path: Path) -> dict[tuple[str, int], list[Finished]]:
    """By row and seed."""
    found: dict[tuple[str, int], list[Finished]] = {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            for line in csv.DictReader(file):
                name = ", ".join(filter(None, (line["group"], line["row"])))
                known = {key: float(text) for key, text in line.items() if key in METRIC and text}
                about = {key: line.get(key, "") for key in _ABOUT}
                run = Finished(name, int(line["seed"]), known, about)
                found.setdefault((name, run.seed), []).append(run)
    return found


def _options(options: Mapping[str, Any]) -> str:
    """As on a command line."""
    words = []
    for name, value in options.items():
        values = value if isinstance(value, tuple | list) else [value]
        words += [f"--{name.replace('_', '-')}", *("none" if v is None else f"{v}" for v in values)]
    return shlex.join(words)
