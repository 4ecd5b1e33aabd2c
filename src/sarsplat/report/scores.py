"""A run's scores as the page's tables, and beside them what they are to be compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sarsplat.evaluation import IMAGE_METRICS, MASK_METRICS, Metric, Scores, Yardstick, metrics_of_points
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


def score_table(title: str, metrics: Sequence[Metric[Any]], columns: Sequence[Scores]) -> ScoreTable:
    """The metrics that the page shows and the first column has, across all columns."""
    rows = []
    for metric in metrics:
        values = [column.values.get(metric.key) for column in columns]
        if metric.place == "file" or values[0] is None:
            continue
        best = metric.best([value for value, column in zip(values, columns, strict=True) if column.ranked])
        cells = (
            Cell(column, metric.text(value), column.ranked and value is not None and value == best)
            for value, column in zip(values, columns, strict=True)
        )
        rows.append(Row(metric, tuple(cells)))
    return ScoreTable(title, tuple(columns), tuple(rows))


def score_tables(metrics: Mapping[str, Any], others: Sequence[Scores] = ()) -> list[ScoreTable]:
    """Tables of `metrics.json`: one for each test set, one for the surface; those without a row are left out.

    Parameters
    ----------
    metrics : mapping
        Content of `metrics.json`.
    others : sequence of Scores
        Other methods that compare; each gets a column in every table.
    """
    tables = [
        score_table(
            f"Unseen views: {split}",
            (*IMAGE_METRICS, *MASK_METRICS),
            [Scores(whose(metrics), values), *baselines(metrics, split), *others],
        )
        for split, values in metrics["images"].items()
    ]
    visible, whole = metrics["points"]["visible"], metrics["points"]["whole"]
    columns = [
        *(Scores(f"{whose(metrics)}, visible surface", visible), Scores("whole surface", whole, ranked=False)),
        *(Scores(f"mesh, {part} surface", values, ranked=False) for part, values in metrics["mesh"].items()),
        *others,
    ]
    of_points = metrics_of_points(Yardstick(metrics["parameters"]["yardstick_m"]))
    tables.append(score_table("Reconstructed surface", of_points, columns))
    return [table for table in tables if table.rows]
