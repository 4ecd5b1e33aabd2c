"""What an experiment is: datasets, trainings, what is reported, and what the paper printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sarsplat.settings.config import DEFAULT_METHOD
from sarsplat.sweeps.results import Result

Options = Mapping[str, Any]

SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes
    ----------
    label : str
        What is special about it.
    datasets : tuple of mapping
        Options of `sarsplat simulate`, or, with a `target_class`, of `import_mstar`; the row is the mean over these
        datasets.
    preset : str
        Of the training; "auto" is the one that fits the images.
    changes : mapping
        Settings that differ from the preset, by their names on the command line.
    group : str
        Heading it stands under.
    x : float or None
        The number that changes from row to row, if one does.
    paper : mapping of str to float
        What the paper printed, by key of the metric.
    random : bool
        Whether the images themselves are drawn from the seed, as speckle is.
    method : str
        What learns.
    scored : str
        Where its scores of images begin, as in `metrics.json`; without: the mean over all test sets.
    full : str
        Label of the row of the whole training: this one lasts as long as the first row of the group.
    once : bool
        Whether only the first seed is done: it takes long.
    """

    label: str
    datasets: tuple[Options, ...]
    preset: str = "default"
    changes: Mapping[str, Any] = field(default_factory=dict)
    group: str = ""
    x: float | None = None
    paper: Mapping[str, float] = field(default_factory=dict)
    random: bool = False
    method: str = DEFAULT_METHOD
    scored: str = ""
    full: str = ""
    once: bool = False

    @property
    def name(self) -> str:
        """What tells it from the other rows."""
        return ", ".join(filter(None, (self.group, self.label)))

    def drawn(self, seed: int) -> list[Options]:
        """Its datasets for one seed."""
        return [{**dataset, **({"seed": seed} if self.random else {})} for dataset in self.datasets]


@dataclass(frozen=True)
class Experiment:
    """One table.

    Attributes
    ----------
    name : str
        Of its files, and on the command line.
    title : str
        Its heading.
    about : str
        What was done, and what the paper's figures beside it are.
    rows : tuple of Row
        Its lines.
    tables : tuple of tuple of str
        Keys of the metrics it reports, a table for each tuple.
    judged : tuple of str
        Keys of the metrics that are drawn, and that the sentence above the table is about.
    axis : str
        What `Row.x` is.
    seeds : tuple of int
        Each row is done with each of them.
    claim : mapping of str to int
        Where the paper says in words how a metric moves with `Row.x`, without figures: 1 up, -1 down.
    alone : bool
        Whether times are measured: one training at a time, on one thread.
    quick : bool
        Whether it is a version in small.
    contest : bool
        Whether rows are held against the first of their group even where the paper has figures.
    pictured : bool
        Whether images and points of every whole training are shown.
    report : callable or None
        Writes the page of runs that are scored together: experiment, results, folder of the sweep, folder of pages.
    """

    name: str
    title: str
    about: str
    rows: tuple[Row, ...]
    tables: tuple[tuple[str, ...], ...]
    judged: tuple[str, ...] = ("cd_m", "f1@0.3")
    axis: str = ""
    seeds: tuple[int, ...] = SEEDS
    claim: Mapping[str, int] = field(default_factory=dict)
    alone: bool = False
    quick: bool = False
    contest: bool = False
    pictured: bool = False
    report: Callable[[Experiment, Sequence[Result], Path, Path], None] | None = None

    @property
    def measured(self) -> bool:
        """Whether it needs measured chips."""
        return any("target_class" in dataset for row in self.rows for dataset in row.datasets)

    def seeds_of(self, row: Row) -> tuple[int, ...]:
        """With which a row is done."""
        return self.seeds[:1] if row.once else self.seeds

    @property
    def columns(self) -> tuple[str, ...]:
        """Keys of all the metrics it reports."""
        return tuple(key for table in self.tables for key in table)

    def groups(self) -> dict[str, list[Row]]:
        """Its rows by heading."""
        groups: dict[str, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(row.group, []).append(row)
        return groups

    def in_small(self) -> Experiment:
        """First, middle and last row of each group, one target or two, one seed, coarse pixels, short trainings."""
        rows, targets = [], 1 if self.report is None else 2
        for group in self.groups().values():
            chosen = sorted({0, len(group) // 2, len(group) - 1})
            labels = {group[k].label for k in chosen} | {group[k].full for k in chosen}
            rows += [
                replace(row, datasets=tuple(map(_coarse, row.datasets[:targets])))
                for row in group
                if row.label in labels
            ]
        return replace(self, rows=tuple(rows), seeds=self.seeds[:1], quick=True)


def _coarse(dataset: Options) -> Options:
    """The same scene with a quarter of the pixels, from fewer sides; chips are what they are."""
    if "target_class" in dataset:
        return dataset
    few = {"azimuth": ("0:360:60",), "grazing": ("45",), "test_azimuth": ("45", "200"), "test_grazing": ("45",)}
    small = {"pixels": (64,), "spacing": tuple(2 * one for one in dataset.get("spacing", (0.3,)))}
    return {**({} if {"azimuth", "random_views"} & dataset.keys() else few), **dataset, **small}


def scene(target: str, **options: Any) -> Options:
    """Options of a simulation by the paper's protocol."""
    return {"target": target, **options}
