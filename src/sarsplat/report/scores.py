"""A run's scores as the page's tables, beside those of baselines and of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sarsplat.evaluation import IMAGE_METRICS, MASK_METRICS, RUN_METRICS, Metric, Scores, Yardstick, metrics_of_points
from sarsplat.evaluation.tables import baselines, whose


@dataclass(frozen=True)
class Cell:
    """One value: its column, and whether it is the best in its row."""

    column: Scores
    text: str
    best: bool


@dataclass(frozen=True)
class Row:
    """One metric across the columns."""

    metric: Metric[Any]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class ScoreTable:
    """A titled table: a column for every method, the run's first, and a row for every metric."""

    title: str
    columns: tuple[Scores, ...]
    rows: tuple[Row, ...]


def score_table(
    title: str, metrics: Sequence[Metric[Any]], columns: Sequence[Scores], deciding: int | None = None
) -> ScoreTable:
    """The metrics that pages show and that any of the first columns, by default of all, has: across all columns."""
    rows = []
    for metric in metrics:
        if metric.place == "file" or all(column.values.get(metric.key) is None for column in columns[:deciding]):
            continue
        values = [column.values.get(metric.key) for column in columns]
        best = metric.best([value for value, column in zip(values, columns, strict=True) if column.ranked])
        cells = (
            Cell(column, metric.text(value), column.ranked and value is not None and value == best)
            for value, column in zip(values, columns, strict=True)
        )
        rows.append(Row(metric, tuple(cells)))
    return ScoreTable(title, tuple(columns), tuple(rows))


def score_tables(metrics: Mapping[str, Any], others: Sequence[Scores] = ()) -> list[ScoreTable]:
    """Tables of `metrics.json`: for each test set and for the surface; each of `others` gets a column in them."""
    tables = []
    for split, values in metrics["images"].items():
        columns = [Scores(whose(metrics), values), *baselines(metrics, split), *others]
        tables.append(score_table(f"Unseen views: {split}", (*IMAGE_METRICS, *MASK_METRICS), columns, deciding=1))
    visible, whole = metrics["points"]["visible"], metrics["points"]["whole"]
    columns = [
        *(Scores(f"{whose(metrics)}, visible surface", visible), Scores("whole surface", whole, ranked=False)),
        *(Scores(f"mesh, {part} surface", values, ranked=False) for part, values in metrics["mesh"].items()),
        *others,
    ]
    of_points = metrics_of_points(Yardstick(metrics["parameters"]["yardstick_m"]))
    tables.append(score_table("Reconstructed surface", of_points, columns, deciding=1))
    return [table for table in tables if table.rows]


def compared_tables(
    names: Sequence[str], every: Sequence[Mapping[str, Any]], *, ranked: bool = True
) -> list[ScoreTable]:
    """Scores of several runs: a table for each test set that any has, one for the surface, one for the training.

    `every` holds the content of the `metrics.json` of each; the best of a row is marked if `ranked`.
    """

    def column(name: str, values: Mapping[str, Any]) -> Scores:
        return Scores(name, values, ranked=ranked)

    tables = []
    for split in dict.fromkeys(split for metrics in every for split in metrics["images"]):
        columns = [column(name, metrics["images"].get(split, {})) for name, metrics in zip(names, every, strict=True)]
        tables.append(score_table(f"Unseen views: {split}", (*IMAGE_METRICS, *MASK_METRICS), columns))
    columns = [column(name, metrics["points"]["visible"]) for name, metrics in zip(names, every, strict=True)]
    cells = dict.fromkeys(metrics["parameters"]["yardstick_m"] for metrics in every)
    of_points = {metric.key: metric for cell in cells for metric in metrics_of_points(Yardstick(cell))}
    tables.append(score_table("Points, visible surface", [*of_points.values()], columns))
    columns = [column(name, {"time_s": metrics["time_s"]}) for name, metrics in zip(names, every, strict=True)]
    tables.append(score_table("Training", RUN_METRICS, columns))
    return [table for table in tables if table.rows]
