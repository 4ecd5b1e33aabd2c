"""Every score that tables can have."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sarsplat.evaluation import Metric, Yardstick, all_metrics
from sarsplat.scenes import paper_grid

METRIC: dict[str, Metric[Any]] = {metric.key: metric for metric in all_metrics(Yardstick.of(paper_grid()))}
METRIC |= {
    "cd_cells": replace(METRIC["cd_m"], key="cd_cells", unit="cells"),
    "f1@cell": replace(METRIC["f1@0.3"], key="f1@cell", label="F1 at a cell"),
    "f1@third": replace(METRIC["f1@0.1"], key="f1@third", label="F1 at a third of a cell"),
}
"""By key: those of the evaluation, and the points' scores in resolution cells, to compare targets of any size."""
