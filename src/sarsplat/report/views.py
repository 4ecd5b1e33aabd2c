"""Unseen views: truth, reconstruction and what lies between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.evaluation import IMAGE_METRICS, Metric
from sarsplat.evaluation.metrics import ImagePair
from sarsplat.reconstruction import Run
from sarsplat.report.figure import Block, Figure
from sarsplat.report.images import Part, difference_bar, power_bar, view_name
from sarsplat.report.residual import Difference, fitted
from sarsplat.report.window import target_window

_VIEWS = 8
_LARGEST = 256
_OURS = "reconstruction"


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
    best_first, metric = ranked_images(dataset, metrics, fewest=3)
    of_note: list[Chosen] = []
    if metric is not None:
        for name, place in (("best", 0), ("median", len(best_first) // 2), ("worst", -1)):
            value, index = best_first[place]
            of_note.append(Chosen(index, f"{name}: {metric.text(value)} {metric.unit}".strip(), metric.label))
    return with_others(dataset, of_note, most - len(of_note))


def ranked_images(
    dataset: Dataset, metrics: Mapping[str, Any] | None, fewest: int = 1
) -> tuple[list[tuple[float, int]], Metric[ImagePair] | None]:
    """Scores of images with their indices, the best first, and what was scored: of the first test set with enough."""
    for split, scored in ((metrics or {}).get("by_image") or {}).items():
        metric = next(metric for metric in IMAGE_METRICS if metric.key == scored["metric"])
        indices = [index for index, entry in enumerate(dataset.entries) if entry.split == split]
        pairs = [pair for pair in zip(scored["scores"], indices, strict=True) if pair[0] is not None]
        if len(pairs) >= fewest:
            return sorted(pairs, reverse=metric.better == "more"), metric
    return [], None


def with_others(dataset: Dataset, chosen: Sequence[Chosen], others: int) -> list[Chosen]:
    """The chosen images, then at most so many other unseen ones, evenly spread."""
    rest = sorted(set(unseen(dataset)) - {one.index for one in chosen})
    return [*chosen, *(Chosen(rest[k]) for k in evenly(len(rest), others) if rest)]


def views_figure(
    title: str, text: str, runs: Mapping[str, Run], chosen: Sequence[Chosen], largest: int = _LARGEST
) -> Figure:
    """Truth, reconstructions and errors of images of the dataset that some runs share.

    `runs` are keyed by what to call their images; images with a side of more than `largest` pixels are averaged.
    """
    dataset = next(iter(runs.values())).dataset
    indices = [one.index for one in chosen]
    views, truth = [dataset.views[index] for index in indices], dataset.power[indices]
    looks = dataset.select(dataset.entries[indices[0]].split).looks
    peak, margin = float(dataset.images("train").max()), dataset.score_margin
    stacks = {name: fitted(truth, run.render(views), looks, margin) for name, run in runs.items()}
    part = Part.of(dataset.grid, target_window(np.maximum.reduce([truth, *stacks.values()]), peak, margin), largest)
    difference = Difference(looks, dataset.grid, peak)
    errors = {name: difference.of(truth, stack) for name, stack in stacks.items()}
    true, alone = "measured" if dataset.calibration == "relative" else "truth", len(runs) == 1
    blocks = []
    for k, one in enumerate(chosen):
        where = view_name(views[k])
        heading = f"{where}{f' ({one.why})' if one.why else ''}"
        images = [part.power(true, f"{true}, {where}", truth[k], peak)]
        images += [part.power(name, f"{name}, {where}", stack[k], peak) for name, stack in stacks.items()]
        wrong = [
            part.difference(
                "error" if alone else name,
                f"error of {'the ' if name == _OURS else ''}{name}, {where}",
                error[k],
                difference.largest,
            )
            for name, error in errors.items()
        ]
        if alone:
            blocks.append(Block(heading, (*images, *wrong)))
        else:
            blocks.append(Block(heading, tuple(images), across=1 + len(runs)))
            blocks.append(Block("error", tuple(wrong), across=1 + len(runs)))
    text += f" {difference.explained}"
    if part.factor > 1:
        text += f" Shown averaged over {part.factor} × {part.factor} pixels."
    return Figure(title, text, tuple(blocks), (power_bar(), difference_bar(difference)))


def unseen_figure(run: Run, chosen: Sequence[Chosen]) -> Figure:
    """Truth, reconstruction and error of some images of a run's dataset."""
    text = f"{_which(run.dataset, chosen)} Power in decibels, the radar above, near range first."
    return views_figure("Unseen views", text, {_OURS: run}, chosen)


def _which(dataset: Dataset, chosen: Sequence[Chosen]) -> str:
    items = unseen(dataset)
    if dataset.entries[items[0]].split == "train":
        return "The dataset has no test views, so these are training views."
    how = "evenly chosen"
    if chosen[0].why:
        how = f"first the best, the median and the worst by {chosen[0].score}, then others, evenly chosen"
    return f"{len(chosen)} of {counted(len(items), 'test view')}, {how}; none of them was trained on."
