"""Scores side by side, and as a table in the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table

from sarsplat.evaluation.metrics import Metric, all_metrics
from sarsplat.evaluation.points import Yardstick
from sarsplat.settings.config import DEFAULT_METHOD


@dataclass(frozen=True)
class Scores:
    """What one method reached."""

    name: str
    """The method, and on what: heading of its column or row."""
    values: Mapping[str, float | None]
    """Values by the metric's key; unknown ones are absent or None."""
    ranked: bool = True
    """Whether it competes for the best value in a table."""


def comparison(metrics: Mapping[str, Any], paper: Scores | None = None) -> list[Scores]:
    """The run's scores on each test set with the baselines of that set, then the paper.

    Parameters
    ----------
    metrics : mapping
        What `evaluate_run` returned, or `metrics.json`.
    paper : Scores, optional
        The paper's figures, where they are comparable.

    Returns
    -------
    list of Scores
        The run's hold the scores of the images, of the points against the visible surface, and of the training.
    """
    common = {**metrics["points"]["visible"], "time_s": metrics["time_s"]}
    rows = []
    for split, values in metrics["images"].items():
        rows.append(Scores(f"{whose(metrics)}, {split}", {**values, **common}))
        rows += [Scores(f"{scores.name}, {split}", scores.values) for scores in baselines(metrics, split)]
    return [*(rows or [Scores(whose(metrics), common)]), *([paper] if paper else [])]


def whose(metrics: Mapping[str, Any]) -> str:
    """Name of the method that was scored."""
    return str(metrics.get("method", DEFAULT_METHOD))


def baselines(metrics: Mapping[str, Any], split: str) -> list[Scores]:
    """Scores of the baselines on one test set."""
    of_set = (metrics["baselines"] or {}).get(split, {})
    return [Scores(name.replace("_", " "), values) for name, values in of_set.items()]


def beaten_by_baselines(metrics: Mapping[str, Any]) -> list[str]:
    """A sentence for each test set whose leading metric is better for a baseline than for the run."""
    by_key = {metric.key: metric for metric in all_metrics(Yardstick(metrics["parameters"]["yardstick_m"]))}
    sentences = []
    for split, values in metrics["images"].items():
        metric = by_key[metrics["by_image"][split]["metric"]]
        own = Scores(whose(metrics), values)
        scores = [own, *baselines(metrics, split)]
        best = metric.best([method.values.get(metric.key) for method in scores])
        winner = next((method for method in scores if best is not None and method.values.get(metric.key) == best), own)
        if winner is not own:
            sentences.append(
                f"on the set {split} the baseline {winner.name}, which knows no third dimension, is better than "
                f"{own.name}: {metric.title} {metric.text(best)} against {metric.text(values.get(metric.key))}"
            )
    return sentences


def summary_metrics(scores: list[Scores], yardstick: Yardstick) -> list[Metric[Any]]:
    """The metrics of a summary: those with a short name that any of the methods has."""
    return [
        metric
        for metric in all_metrics(yardstick)
        if metric.short and any(method.values.get(metric.key) is not None for method in scores)
    ]


def metrics_table(scores: list[Scores], yardstick: Yardstick, caption: str | None = None) -> Table:
    """A line for each of the scores that `comparison` returned, a column for each metric of the summary; "–" is None.

    `yardstick` is what the points were scored with; `caption` is a note below the table.
    """
    shown = summary_metrics(scores, yardstick)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True, caption=caption, caption_justify="left")
    table.add_column("", no_wrap=True)
    for metric in shown:
        words = [*metric.heading.split(), *(metric.text(method.values.get(metric.key)) for method in scores)]
        table.add_column(metric.heading, justify="right", min_width=max(map(len, words)))  # headings may wrap
    for method in scores:
        table.add_row(method.name, *(metric.text(method.values.get(metric.key)) for metric in shown))
    return table
