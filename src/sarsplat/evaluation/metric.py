"""What describes a metric, and how a list of metrics is computed; the metrics themselves are in `metrics.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from sarsplat.data import Dataset
from sarsplat.evaluation.images import UndefinedScore


@dataclass(frozen=True)
class Requirement:
    """A condition on the dataset for a metric to apply, and the reason to give where it is not met."""

    met: Callable[[Dataset], bool]
    otherwise: str


NOTHING = Requirement(lambda dataset: True, "")

Measured = TypeVar("Measured")


@dataclass(frozen=True)
class Metric(Generic[Measured]):
    """One metric."""

    key: str
    """Its name in `metrics.json`."""
    label: str
    """Its name for readers, without the unit."""
    unit: str
    """Its unit; empty if it has none."""
    digits: str
    """How it is printed, as Python formats numbers: lengths with three significant digits, whatever their size."""
    better: Literal["more", "less"] | None
    """Which of two values is the better one; None if neither is."""
    definition: str
    """What exactly is computed, in one line."""
    compute: Callable[[Measured], float]
    """Its value; raises `UndefinedScore` where it has none."""
    requires: Requirement = NOTHING
    """To which datasets it applies."""
    short: str = ""
    """Heading of its column in the terminal, without the unit; empty if it has no column there and in the README."""
    place: Literal["headline", "table", "file"] = "table"
    """In the report: large at the top and in the table, in the table only, or not at all."""

    @property
    def title(self) -> str:
        """Label and unit: `Chamfer distance, m`."""
        return f"{self.label}, {self.unit}" if self.unit else self.label

    @property
    def heading(self) -> str:
        """Short name and unit: `CD m`."""
        return f"{self.short} {self.unit}".strip()

    @property
    def arrow(self) -> str:
        """↑ if more is better, ↓ if less is."""
        return {"more": "↑", "less": "↓", None: ""}[self.better]

    def text(self, value: float | None) -> str:
        """The value with the metric's digits; a dash for None."""
        return "–" if value is None else f"{value:{self.digits}}".rstrip(".")

    def best(self, values: Sequence[float | None]) -> float | None:
        """The best of several values; None if there is nothing to compare."""
        defined = [value for value in values if value is not None]
        if self.better is None or len(defined) < 2:
            return None
        return max(defined) if self.better == "more" else min(defined)


def compute_all(
    metrics: Sequence[Metric[Measured]],
    dataset: Dataset,
    measured: Measured | UndefinedScore,
    prefix: str,
    reasons: dict[str, str],
) -> dict[str, float | None]:
    """Value of every metric; None, with the reason noted, where it does not apply or has no value.

    Parameters
    ----------
    metrics : sequence of Metric
        What to compute.
    dataset : Dataset
        Decides which of them apply.
    measured : Measured or UndefinedScore
        What they are computed from, or why there is nothing.
    prefix : str
        What stands before a metric's key in `reasons`: empty, or ending in a dot.
    reasons : dict of str to str
        Filled in: dotted key of each metric that is None, and why.
    """
    values: dict[str, float | None] = {}
    for metric in metrics:
        try:
            if not metric.requires.met(dataset):
                raise UndefinedScore(metric.requires.otherwise)
            if isinstance(measured, UndefinedScore):
                raise measured
            values[metric.key] = metric.compute(measured)
        except UndefinedScore as undefined:
            values[metric.key] = None
            reasons[prefix + metric.key] = str(undefined)
    return values
