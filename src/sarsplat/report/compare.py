"""Several runs side by side: their scores, the same views, and their points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sarsplat.data import new_folder, write_bytes
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import IMAGE_METRICS, Yardstick
from sarsplat.reconstruction import AnyRun
from sarsplat.report.cloud import point_boards
from sarsplat.report.figure import Block, Figure
from sarsplat.report.images import Part, difference_bar, power_bar, view_name
from sarsplat.report.page import rendered
from sarsplat.report.residual import Difference, fitted
from sarsplat.report.scores import ScoreTable, compared_tables
from sarsplat.report.views import Chosen, evenly, unseen
from sarsplat.report.window import target_window
from sarsplat.report.write import sampled, scores_expected

PAGE = "comparison.html"

_VIEWS = 6
_LARGEST = 192
"""Pixels along a side that the page shows of an image; larger ones are averaged."""


@dataclass(frozen=True)
class Comparison:
    """Runs side by side.

    Attributes
    ----------
    runs : tuple of AnyRun
        By any methods, all evaluated.
    names : tuple of str
        What to call them: their folders' names, or paths where names are the same.
    tables : tuple of ScoreTable
        A row for every metric, a column for every run.
    caution : str or None
        What must be said if they were not made from the same dataset.
    """

    runs: tuple[AnyRun[Any], ...]
    names: tuple[str, ...]
    tables: tuple[ScoreTable, ...]
    caution: str | None


def compare(runs: Sequence[AnyRun[Any]]) -> Comparison:
    """Put the scores of two or more evaluated runs side by side.

    Raises
    ------
    SarsplatError
        If there are fewer than two runs, one is given twice, has not been evaluated, or its `metrics.json` is of
        another make.
    """
    if len(runs) < 2:
        raise SarsplatError(f"{len(runs)} run cannot be compared with others; give at least two")
    paths = [run.folder.resolve() for run in runs]
    for index, (run, path) in enumerate(zip(runs, paths, strict=True)):
        if path in paths[:index]:
            raise SarsplatError(f"{run.folder} is given twice; give each run once")
        with scores_expected(run):
            compared_tables([""], [scores_of(run)])
    short = [path.name for path in paths]
    names = short if len(set(short)) == len(short) else [str(run.folder) for run in runs]
    caution = _caution(runs, names)
    tables = compared_tables(names, [scores_of(run) for run in runs], ranked=caution is None)
    return Comparison(tuple(runs), tuple(names), tuple(tables), caution)


def write_comparison(comparison: Comparison, out: Path, *, overwrite: bool = False) -> Path:
    """Write the comparison as one page that needs no network, `OUT/comparison.html`, and return its path.

    Parameters
    ----------
    comparison : Comparison
        What `compare` returned.
    out : Path
        Folder to make.
    overwrite : bool
        Whether an existing comparison there may be replaced.

    Raises
    ------
    SarsplatError
        If the dataset of a run is missing, or `out` exists and may not be replaced.
    """
    definitions: dict[str, str] = {}
    for run in comparison.runs:
        definitions |= scores_of(run)["definitions"]
    html = rendered(
        "compare.html.j2",
        target=" and ".join(dict.fromkeys(run.dataset.target for run in comparison.runs)),
        lead=f"{', '.join(comparison.names[:-1])} and {comparison.names[-1]} side by side.",
        caution=comparison.caution,
        tables=comparison.tables,
        definitions=definitions,
        figures=[draw(part) for part in _by_dataset(comparison) for draw in (_views, _points)],
    )
    with new_folder(out, overwrite, marker=PAGE) as folder:
        write_bytes(folder / PAGE, html.encode())
    return out / PAGE


def scores_of(run: AnyRun[Any]) -> Mapping[str, Any]:
    """Content of a run's `metrics.json`.

    Raises
    ------
    SarsplatError
        If it has not been evaluated.
    """
    if (metrics := run.metrics) is None:
        raise SarsplatError(f"{run.folder} has no scores yet; run `sarsplat evaluate {run.folder}` first")
    return metrics


def _caution(runs: Sequence[AnyRun[Any]], names: Sequence[str]) -> str | None:
    if len({run.fingerprint for run in runs}) == 1:
        return None
    made = ", ".join(
        f"{name} from {run.dataset_path or 'images in memory'}" for name, run in zip(names, runs, strict=True)
    )
    return f"These runs were made from different datasets, so their scores do not compare one to one: {made}."


def _by_dataset(comparison: Comparison) -> list[Comparison]:
    """The runs of each dataset on their own: no picture stands beside another dataset's truth."""
    shared: dict[str | None, list[int]] = {}
    for index, run in enumerate(comparison.runs):
        shared.setdefault(run.fingerprint, []).append(index)
    return [
        replace(
            comparison,
            runs=tuple(comparison.runs[k] for k in indices),
            names=tuple(comparison.names[k] for k in indices),
        )
        for indices in shared.values()
    ]


def _title(what: str, comparison: Comparison) -> str:
    """Says whose pictures these are where the page shows several datasets."""
    return f"{what}: {', '.join(comparison.names)}" if comparison.caution else what


def _views(comparison: Comparison) -> Figure:
    """The same views rendered by every run of one dataset, and their errors."""
    names, dataset = comparison.names, comparison.runs[0].dataset
    chosen = _chosen(comparison)
    indices = [one.index for one in chosen]
    views = [dataset.views[index] for index in indices]
    looks = dataset.select(dataset.entries[indices[0]].split).looks
    peak = float(dataset.images("train").max())
    truth, difference = dataset.power[indices], Difference(looks, dataset.grid, peak)
    stacks = {
        name: fitted(truth, run.render(views), looks, dataset.score_margin)
        for name, run in zip(names, comparison.runs, strict=True)
    }
    brightest = np.maximum.reduce([truth, *stacks.values()])
    part = Part.of(dataset.grid, target_window(brightest, peak, dataset.score_margin), _LARGEST)
    errors = {name: difference.of(truth, stack) for name, stack in stacks.items()}
    true = "measured" if dataset.calibration == "relative" else "truth"
    blocks = []
    for k, one in enumerate(chosen):
        where = view_name(views[k])
        panels = [part.power(true, f"{true}, {where}", truth[k], peak)]
        panels += [part.power(name, f"{name}, {where}", stacks[name][k], peak) for name in names]
        blocks.append(Block(f"{where}{f' ({one.why})' if one.why else ''}", tuple(panels), across=1 + len(names)))
        wrong = [
            part.difference(name, f"error of {name}, {where}", error[k], difference.largest)
            for name, error in errors.items()
        ]
        blocks.append(Block("error", tuple(wrong), across=1 + len(names)))
    text = f"{true.capitalize()} and reconstructions on one scale, the radar above. {difference.explained}"
    return Figure(_title("The same views", comparison), text, tuple(blocks), (power_bar(), difference_bar(difference)))


def _chosen(comparison: Comparison) -> list[Chosen]:
    """The worst unseen view of each run of one dataset, then others, evenly spread."""
    dataset, found = comparison.runs[0].dataset, dict[int, str]()
    for name, run in zip(comparison.names, comparison.runs, strict=True):
        scored = scores_of(run).get("by_image", {})
        for split, worst in ((split, _worst(scores)) for split, scores in list(scored.items())[:1]):
            if worst is not None:
                index = [k for k, entry in enumerate(dataset.entries) if entry.split == split][worst]
                found[index] = f"{found[index]}, {name}" if index in found else f"worst of {name}"
    rest = [index for index in unseen(dataset) if index not in found]
    others = [rest[k] for k in evenly(len(rest), max(2, _VIEWS - len(found)))] if rest else []
    return [Chosen(index, why) for index, why in found.items()] + [Chosen(index) for index in others]


def _worst(scores: Mapping[str, Any]) -> int | None:
    metric = next(metric for metric in IMAGE_METRICS if metric.key == scores["metric"])
    known = [(value, k) for k, value in enumerate(scores["scores"]) if value is not None]
    if not known:
        return None
    return (min(known) if metric.better == "more" else max(known))[1]


def _points(comparison: Comparison) -> Figure:
    first = comparison.runs[0]
    truth = first.dataset.truth_mesh
    clouds = {name: run.points for name, run in zip(comparison.names, comparison.runs, strict=True)}
    farthest_m = Yardstick.of(first.dataset.grid).thresholds_m[1]
    blocks, bars = point_boards(clouds, None if truth is None else sampled(truth), farthest_m)
    compared = "" if truth is None else ", and their distances from the true surface"
    text = f"The surface points of every run, in the same space and colours{compared}."
    return Figure(_title("Points", comparison), text, blocks, bars)
