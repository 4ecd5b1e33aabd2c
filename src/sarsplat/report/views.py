"""Unseen views: truth, reconstruction and what lies between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.evaluation import IMAGE_METRICS
from sarsplat.reconstruction import AnyRun
from sarsplat.report.figure import Block, Figure
from sarsplat.report.images import Part, difference_bar, power_bar, view_name
from sarsplat.report.residual import Difference, fitted
from sarsplat.report.window import target_window

_VIEWS = 8
_LARGEST = 256
"""Pixels along a side that a page shows of an image; larger ones are averaged."""


@dataclass(frozen=True)
class Chosen:
    """An image of the dataset that is shown: its index, why, and the score that decided it."""

    index: int
    why: str = ""
    score: str = ""


def evenly(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` indices, evenly spread, both ends among them."""
    return sorted({int(index) for index in np.linspace(0, count - 1, min(count, wanted)).round()})


def unseen(dataset: Dataset) -> list[int]:
    """Indices of the test images, or of the training images where there are none."""
    tests = [index for index, entry in enumerate(dataset.entries) if entry.split != "train"]
    return tests or list(range(len(dataset)))


def chosen_views(dataset: Dataset, metrics: Mapping[str, Any] | None, most: int = _VIEWS) -> list[Chosen]:
    """The best, the median and the worst of the unseen images if they were scored, then others, evenly spread."""
    items = unseen(dataset)
    found: list[Chosen] = []
    for split, scored in ((metrics or {}).get("by_image") or {}).items():
        key, values = scored["metric"], scored["scores"]
        metric = next(metric for metric in IMAGE_METRICS if metric.key == key)
        known = [index for index, entry in enumerate(dataset.entries) if entry.split == split]
        pairs = zip(known, values, strict=True)
        order = sorted((value, index) for index, value in pairs if value is not None)
        if metric.better == "more":
            order.reverse()
        if found or len(order) < 3:  # of several test sets, the first
            continue
        for name, (value, index) in (("best", order[0]), ("median", order[len(order) // 2]), ("worst", order[-1])):
            why = f"{name}: {metric.text(value)} {metric.unit}".strip()
            found.append(Chosen(index, why, metric.label))
    rest = sorted(set(items) - {one.index for one in found})
    return [*found, *(Chosen(rest[k]) for k in evenly(len(rest), most - len(found)) if rest)]


def views_figure(run: AnyRun[Any], chosen: Sequence[Chosen]) -> Figure:
    """Truth, reconstruction and error of some images of a run's dataset."""
    dataset, grid = run.dataset, run.dataset.grid
    indices = [one.index for one in chosen]
    looks = dataset.select(dataset.entries[indices[0]].split).looks
    peak = float(dataset.images("train").max())
    truth = dataset.power[indices]
    rendered = fitted(truth, run.render([dataset.views[k] for k in indices]), looks, dataset.score_margin)
    part = Part.of(grid, target_window(np.maximum(truth, rendered), peak, dataset.score_margin), _LARGEST)
    difference = Difference(looks, grid, peak)
    name = "measured" if dataset.calibration == "relative" else "truth"
    blocks = []
    for one, true, ours, error in zip(chosen, truth, rendered, difference.of(truth, rendered), strict=True):
        where = view_name(dataset.views[one.index])
        panels = (
            part.power(name, f"{name}, {where}", true, peak),
            part.power("reconstruction", f"reconstruction, {where}", ours, peak),
            part.difference("error", f"error of the reconstruction, {where}", error, difference.largest),
        )
        blocks.append(Block(f"{where}{f' ({one.why})' if one.why else ''}", panels))
    text = f"{_which(dataset, chosen)} Power in decibels, the radar above, near range first. {difference.explained}"
    if part.factor > 1:
        text += f" Shown averaged over {part.factor} × {part.factor} pixels."
    return Figure("Unseen views", text, tuple(blocks), (power_bar(), difference_bar(difference)))


def _which(dataset: Dataset, chosen: Sequence[Chosen]) -> str:
    items = unseen(dataset)
    if dataset.entries[items[0]].split == "train":
        return "The dataset has no test views, so these are training views."
    how = "evenly chosen"
    if chosen[0].why:
        how = f"first the best, the median and the worst by {chosen[0].score}, then others, evenly chosen"
    return f"{len(chosen)} of {counted(len(items), 'test view')}, {how}; none of them was trained on."
