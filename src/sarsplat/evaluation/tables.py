"""Comparison of scores, and their table in the terminal."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table

from sarsplat.evaluation.metrics import IMAGE_METRICS, Metric, all_metrics
from sarsplat.evaluation.points import Yardstick
from sarsplat.settings.config import DEFAULT_METHOD


@dataclass(frozen=True)
class Scores:
    """Scores of one method."""

    name: str
    """Heading of its column or row: method and test set."""
    values: Mapping[str, float | None]
    """Values by metric key; unknown ones are absent or None."""
    ranked: bool = True
    """True if it competes for the best value in a table."""


def comparison(metrics: Mapping[str, Any], paper: Scores | None = None) -> list[Scores]:
    """The run's scores on each test set with the baselines of that set, then the paper where that is comparable.

    `metrics` is the result of `evaluate_run`, or `metrics.json`. The run's scores are of images, of points against the
    visible surface, and of the training.
    """
    common = {**metrics["points"]["visible"], "time_s": metrics["time_s"]}
    rows = []
    for split, values in metrics["images"].items():
        rows.append(Scores(f"{whose(metrics)}, {split}", {**values, **common}))
        rows += [Scores(f"{scores.name}, {split}", scores.values) for scores in baselines(metrics, split)]
    return [*(rows or [Scores(whose(metrics), common)]), *([paper] if paper else [])]


def whose(metrics: Mapping[str, Any]) -> str:
    """Name of the scored method."""
    return str(metrics.get("method", DEFAULT_METHOD))


def baselines(metrics: Mapping[str, Any], split: str) -> list[Scores]:
    """Scores of the baselines on one test set."""
    of_set = (metrics["baselines"] or {}).get(split, {})
    return [Scores(name.replace("_", " "), values) for name, values in of_set.items()]


@dataclass(frozen=True)
class Beaten:
    """A test set on which a baseline is better than a run."""

    split: str
    by: str
    """The best baseline."""
    metric: Metric[Any]
    """Leading metric of these images."""
    best: float
    """Value of the baseline."""
    own: float | None
    """Value of the run."""

    @property
    def figures(self) -> str:
        """Both values in words, the baseline's first: `0.8 against 0.7`."""
        own = ", where the other has no score" if self.own is None else f" against {self.metric.text(self.own)}"
        return f"{self.metric.text(self.best)}{own}"

    def sentence(self, name: str) -> str:
        """Return a sentence about a run of this name."""
        return (
            f"on the set {self.split} the baseline {self.by}, which knows no third dimension, is better than {name}: "
            f"{self.metric.title} {self.figures}"
        )


def beaten(metrics: Mapping[str, Any]) -> list[Beaten]:
    """Test sets on which a baseline is better than the run, from `metrics.json` or its `images` and `baselines`."""
    found = []
    for split, own in metrics["images"].items():
        others = baselines(metrics, split)
        scores = [own, *(other.values for other in others)]
        headline = (metric for metric in IMAGE_METRICS if metric.place == "headline")
        metric = next((one for one in headline if any(values.get(one.key) is not None for values in scores)), None)
        best = None if metric is None else metric.best([values.get(metric.key) for values in scores])
        if metric is None or best is None or own.get(metric.key) == best:
            continue
        winner = next(other for other in others if other.values.get(metric.key) == best)
        found.append(Beaten(split, winner.name, metric, best, own.get(metric.key)))
    return found


def beaten_by_baselines(metrics: Mapping[str, Any]) -> list[str]:
    """A sentence for each test set whose leading metric is better for a baseline than for the run."""
    return [one.sentence(whose(metrics)) for one in beaten(metrics)]


def summary_metrics(scores: list[Scores], yardstick: Yardstick) -> list[Metric[Any]]:
    """Metrics with a short name that any of the methods has."""
    return [
        metric
        for metric in all_metrics(yardstick)
        if metric.short and any(method.values.get(metric.key) is not None for method in scores)
    ]


def metrics_table(scores: list[Scores], yardstick: Yardstick, caption: str | None = None) -> Table:
    """Return a table with a line for each `Scores` and a column for each summary metric; "–" is None.

    `yardstick` is that of the scored points; `caption` is a note below the table.
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
