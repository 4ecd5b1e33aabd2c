"""Unseen views: truth, reconstruction and error, and the outlines of true and predicted masks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sarsplat.data import Dataset, read_masks
from sarsplat.errors import counted
from sarsplat.evaluation import IMAGE_METRICS, Metric, UndefinedScore, predicted_masks
from sarsplat.evaluation.metrics import ImagePair
from sarsplat.radiometry import white_level
from sarsplat.report.figure import Block, Figure, Panel, polyline
from sarsplat.report.images import Difference, Images, Part, fitted, power_bar, target_window, view_name
from sarsplat.runs import Run

_VIEWS = 8
_LARGEST = 256
_OWN = "reconstruction"
_MARGIN = 5  # pixels around everything that a mask shows
_KINDS = {1: "target", 2: "shadow"}


@dataclass(frozen=True)
class Chosen:
    """An image of the dataset that is shown: its index, why, and the score that decided it."""

    index: int
    why: str = ""
    score: str = ""


def evenly(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` indices, evenly spread, both ends among them."""
    return sorted({int(index) for index in np.linspace(0, count - 1, min(count, wanted)).round()})


def _unseen(dataset: Dataset) -> list[int]:
    """Indices of the test images, or of all images if there are no tests."""
    tests = [index for index, entry in enumerate(dataset.entries) if entry.split != "train"]
    return tests or list(range(len(dataset)))


def chosen_views(dataset: Dataset, metrics: Mapping[str, Any] | None) -> list[Chosen]:
    """Choose the best, median and worst of the scored unseen images, then others, evenly spread."""
    best_first, metric = ranked_images(dataset, metrics, fewest=3)
    of_note: list[Chosen] = []
    if metric is not None:
        for name, place in (("best", 0), ("median", len(best_first) // 2), ("worst", -1)):
            value, index = best_first[place]
            of_note.append(Chosen(index, f"{name}: {metric.text(value)} {metric.unit}".strip(), metric.label))
    return with_others(dataset, of_note, _VIEWS - len(of_note))


def ranked_images(
    dataset: Dataset, metrics: Mapping[str, Any] | None, fewest: int = 1
) -> tuple[list[tuple[float, int]], Metric[ImagePair] | None]:
    """Scores with image indices, best first, and their metric, of the first test set with at least `fewest` scores."""
    for split, scored in ((metrics or {}).get("by_image") or {}).items():
        metric = next(metric for metric in IMAGE_METRICS if metric.key == scored["metric"])
        indices = [index for index, entry in enumerate(dataset.entries) if entry.split == split]
        pairs = [pair for pair in zip(scored["scores"], indices, strict=True) if pair[0] is not None]
        if len(pairs) >= fewest:
            return sorted(pairs, reverse=metric.better == "more"), metric
    return [], None


def with_others(dataset: Dataset, chosen: Sequence[Chosen], others: int) -> list[Chosen]:
    """The chosen images, then at most `others` other unseen ones, evenly spread."""
    rest = sorted(set(_unseen(dataset)) - {one.index for one in chosen})
    return [*chosen, *(Chosen(rest[k]) for k in evenly(len(rest), others) if rest)]


def views_figure(
    title: str, text: str, runs: Mapping[str, Run], chosen: Sequence[Chosen], largest: int = _LARGEST, across: int = 0
) -> Figure:
    """Truth, reconstructions and errors of chosen images of the dataset that the runs share.

    `runs` are keyed by name; images with a side of more than `largest` pixels are averaged. With `across`, the figure
    is a sheet: a row for the truth and for every run, with room for at least `across` panels.
    """
    dataset = next(iter(runs.values())).dataset
    indices = [one.index for one in chosen]
    views, truth = [dataset.views[index] for index in indices], dataset.power[indices]
    looks = dataset.select(dataset.entries[indices[0]].split).looks
    peak, margin = white_level(dataset.images("train")), dataset.score_margin
    shown = dataset.take(indices)
    stacks = {name: fitted(truth, run.render(run.views_of(shown)), looks, margin) for name, run in runs.items()}
    part = Part.of(dataset.grid, target_window(np.maximum.reduce([truth, *stacks.values()]), peak, margin), largest)
    difference = Difference(looks, dataset.grid, peak)
    errors = {name: difference.of(truth, stack) for name, stack in stacks.items()}
    true = "measured" if dataset.calibration == "relative" else "truth"
    names = [f"{view_name(views[k])}{f' ({one.why})' if one.why else ''}" for k, one in enumerate(chosen)]

    def power(name: str, images: Images, k: int, title: str) -> Panel:
        return part.power(title, f"{name}, {view_name(views[k])}", images[k], peak)

    def error(name: str, images: Images, k: int, title: str) -> Panel:
        alt = f"error of {'the ' if name == _OWN else ''}{name}, {view_name(views[k])}"
        return part.difference(title, alt, images[k], difference.largest)

    rows = [(true, power, true, truth), *((name, power, name, stack) for name, stack in stacks.items())]
    rows += [(f"error of {name}" if across else "error", error, name, stack) for name, stack in errors.items()]
    blocks = []
    if across:
        for index, (heading, draw, name, images) in enumerate(rows):
            panels = tuple(draw(name, images, k, "" if index else names[k]) for k in range(len(names)))
            blocks.append(Block(heading, panels, across=max(across, len(names))))
    else:  # a block for every view
        for k, heading in enumerate(names):
            blocks.append(Block(heading, tuple(draw(name, images, k, title) for title, draw, name, images in rows)))
    text += f" {difference.explained}"
    if part.factor > 1:
        text += f" Shown averaged over {part.factor} × {part.factor} pixels."
    layout = "sheet" if across else ""
    return Figure(title, text, tuple(blocks), (power_bar(), difference.bar), layout=layout)


def unseen_figure(run: Run, chosen: Sequence[Chosen]) -> Figure:
    """Truth, reconstruction and error of some images of a run's dataset."""
    items, how = _unseen(run.dataset), "evenly chosen"
    if chosen[0].why:
        how = f"first the best, the median and the worst by {chosen[0].score}, then others, evenly chosen"
    which = f"{len(chosen)} of {counted(len(items), 'test view')}, {how}; none of them was trained on."
    if run.dataset.entries[items[0]].split == "train":
        which = "The dataset has no test views, so these are training views."
    text = f"{which} Power in decibels, the radar above, near range first."
    return views_figure("Unseen views", text, {_OWN: run}, chosen)


# ---- masks ----------------------------------------------------------------------------------------------------------
def masks_figure(run: Run) -> Figure | None:
    """Test images with outlines of predicted masks and of the true ones that the run was evaluated with.

    None without true masks, or if none can be predicted.
    """
    dataset, folder = run.dataset, run.metrics and run.metrics.get("masks")
    if folder is None:
        return None
    masks = read_masks(Path(folder), dataset)
    masked = list(masks)
    chosen = [masked[index] for index in evenly(len(masked), _VIEWS)]
    looks = dataset.select(dataset.entries[chosen[0]].split).looks
    images = replace(dataset.take(chosen), looks=looks, clean_tests=False)
    try:
        predicted = predicted_masks(run, images, run.render(images.views))
    except UndefinedScore:  # the evaluation gives the reason
        return None
    truth = np.stack([masks[index] for index in chosen])
    union = np.maximum(truth, predicted).max(axis=0)
    rows, columns = (_margined(union.max(axis=1 - axis)) for axis in (0, 1))
    part = Part.of(dataset.grid, (rows, columns), _LARGEST)
    peak = white_level(dataset.images("train"))
    panels = []
    for image, view, true, own in zip(images.power, images.views, truth, predicted, strict=True):
        drawing = _outlines(true[rows, columns], "true") + _outlines(own[rows, columns], "own")
        alt = f"{view_name(view)}, with the outlines of the true and the predicted target and shadow"
        panels.append(part.power(view_name(view), alt, image, peak, drawing))
    text = (
        f"{len(chosen)} of {len(masked)} test views with true masks, evenly chosen. The predicted outlines are those "
        "of the learned geometry"
    )
    if looks is not None:
        text += ", shifted by whole pixels to where the rendered image fits the measured one best"
    return Figure("Target and shadow", f"{text}.", (Block("", tuple(panels)),), (power_bar(),), legend="outlines")


def _outlines(mask: UInt8[np.ndarray, "rows columns"], whose: str) -> str:
    """The outlines of target and shadow as SVG, in a square that the mask fills."""
    from skimage.measure import find_contours

    drawn = ""
    rows, columns = mask.shape
    for value, name in _KINDS.items():
        present = np.pad((mask == value).astype(float), 1)
        for line in find_contours(present, 0.5):
            places = line - 0.5  # pixel k of the padded mask has its centre at k − 0.5 pixels of the mask
            drawn += polyline(places[:, 1] / columns, 1 - places[:, 0] / rows, f"outline {whose} {name}")
    return drawn


def _margined(present: UInt8[np.ndarray, " n"]) -> slice:
    """Bounding rows and columns of the set pixels, with a margin; the whole image if none is set."""
    covered = np.flatnonzero(present)
    if len(covered) == 0:
        return slice(0, len(present))
    return slice(max(int(covered[0]) - _MARGIN, 0), min(int(covered[-1]) + 1 + _MARGIN, len(present)))
