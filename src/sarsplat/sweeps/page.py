"""Page of a sweep: table, figures of the swept settings, warnings, failures, and links to all reports."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sarsplat.errors import counted
from sarsplat.evaluation import Metric
from sarsplat.report.figure import Axis, Block, Figure, Panel, axis, chart, polyline
from sarsplat.report.page import in_words, rendered
from sarsplat.sweeps.cell import NAMES
from sarsplat.sweeps.results import Line, Result, Results, Spread, label_text
from sarsplat.sweeps.work import RUNS

_SETTLED = (*NAMES, "test set")  # labels that are not settings
_DECADE = 8.0  # ratio of largest to smallest value above which a setting's axis is logarithmic


@dataclass(frozen=True)
class _Row:
    texts: Sequence[str]
    link: str = ""


def page(results: Results) -> str:
    """Page as HTML; it needs no other file but the reports that it links to."""
    lines = results.lines()
    names, metrics = results.columns()
    states = Counter(one.state for one in results.results)
    datasets = dict.fromkeys(str(one.cell.labels["dataset"]) for one in results.results)
    rows = (one.row for one in results.results if one.row is not None and one.finished)
    warned = Counter(text for row in rows for text in dict.fromkeys(row.warnings))
    few = [*datasets] if len(datasets) <= 3 else [counted(len(datasets), "dataset")]
    return rendered(
        "sweep_page.html.j2",
        target=in_words(few),
        lead=f"{counted(len(results.results), 'run')}: {in_words(f'{n:,} {state}' for state, n in states.items())}.",
        unfinished="waiting" in states,
        heads=[*names, "runs", *(f"{metric.heading} {metric.arrow}".strip() for metric in metrics)],
        beaten=results.beaten,
        lines=[_Row(line.texts(names, metrics)) for line in (*lines, *results.baselines())],
        figures=[figure for name in names if name not in _SETTLED for figure in _figure(name, lines, metrics)],
        warned=[_Row((text, counted(number, "run"))) for text, number in warned.most_common()],
        failed=[_Row((one.cell.words(names), one.reason)) for one in results.failed],
        run_heads=[*(name for name in names if name != "test set"), "seed", "state", "run"],
        runs=[_run(one, [name for name in names if name != "test set"], results) for one in results.results],
    )


def _run(one: Result, names: Sequence[str], results: Results) -> _Row:
    labels = [label_text(one.cell.labels.get(name, "")) for name in names]
    place = "" if one.row is None else f"{RUNS}/{one.row.address}"
    report = f"{place}/report/index.html"
    text, link = "", ""
    if place and (results.out / report).is_file():
        text, link = "report", report
    elif place and (results.out / place).is_dir():
        text, link = "folder", f"{place}/"
    worse = "".join(f", worse than {where.by} on {where.split}" for where in one.beaten)
    return _Row([*labels, str(one.cell.seed), one.state + worse, text], link)


def _figure(name: str, lines: Sequence[Line], metrics: Sequence[Metric[Any]]) -> list[Figure]:
    """Headline scores against one setting, averaged over the other swept settings."""
    drawn = [metric for metric in metrics if metric.place == "headline" or metric.key == "time_s"]
    groups: dict[str, list[Line]] = {}
    for line in lines:
        if name in line.labels:
            words = (str(line.labels.get(label, "")) for label in ("part", "method", "preset", "test set"))
            groups.setdefault(", ".join(filter(None, words)), []).append(line)
    blocks = []
    for title, members in groups.items():
        values = sorted({line.labels[name] for line in members}, key=_order)
        panels = [panel for metric in drawn if (panel := _panel(name, values, members, metric)) is not None]
        if len(values) > 1 and panels:
            blocks.append(Block(title if len(groups) > 1 else "", tuple(panels)))
    text = (
        "Dots are means over all other settings that are finished at all of these values, bands one standard deviation "
        "over the seeds."
    )
    return [Figure(name, text, tuple(blocks))] if blocks else []


def _panel(name: str, values: Sequence[Any], lines: Sequence[Line], metric: Metric[Any]) -> Panel | None:
    others: dict[str, dict[Any, Spread]] = {}  # spreads by value, for each combination of the other labels
    for line in lines:
        if spread := line.spreads.get(metric.key):
            rest = {label: one for label, one in line.labels.items() if label != name}
            others.setdefault(repr(rest), {})[repr(line.labels[name])] = spread
    largest: dict[Any, Spread] = max(others.values(), key=len, default={})
    complete = [spreads for spreads in others.values() if spreads.keys() >= largest.keys()]  # comparable at all values
    found = {
        index: averaged
        for index, value in enumerate(values)
        if (averaged := _averaged([spreads[repr(value)] for spreads in complete if repr(value) in spreads]))
    }
    if not found:
        return None
    places = _places(values)
    x = np.array([places[index] for index in found])
    mean = np.array([spread.mean for spread in found.values()])
    sd = np.array([spread.sd or 0.0 for spread in found.values()])
    low, high = float((mean - sd).min()), float((mean + sd).max())
    room = 0.08 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - room, high + room

    def share(heights: np.ndarray) -> np.ndarray:
        return (heights - low) / (high - low)

    band = polyline(np.concatenate([x, x[::-1]]), share(np.concatenate([mean + sd, (mean - sd)[::-1]])), "band")
    dots = [polyline(np.array([a, a]), share(np.array([b, b])), "dot accent") for a, b in zip(x, mean, strict=True)]
    across = Axis(name, tuple((place, label_text(value)) for place, value in zip(places, values, strict=True)))
    parts = [band, polyline(x, share(mean), "line accent"), *dots]
    return chart(metric.title, f"{metric.title} against {name}", across, axis(metric.unit, high, low), parts)


def _averaged(spreads: Sequence[Spread]) -> Spread | None:
    """Mean, seed by seed, over the lines with the most seeds; others are left out."""
    most = max((len(one.values) for one in spreads), default=0)
    complete = [one.values for one in spreads if len(one.values) == most]
    return Spread(tuple(float(np.mean(of_seed)) for of_seed in zip(*complete, strict=True))) if complete else None


def _places(values: Sequence[Any]) -> list[float]:
    """Positions of values on an axis from 0 to 1: numbers by their size, words evenly spaced."""
    if all(isinstance(value, int | float) for value in values):
        size = np.array(values, dtype=float)
        if size.min() > 0 and size.max() > _DECADE * size.min():
            size = np.log(size)
    else:
        size = np.arange(len(values), dtype=float)
    reach = float(size.max() - size.min()) or 1.0
    return [0.04 + 0.92 * float(one) for one in (size - size.min()) / reach]


def _order(value: Any) -> tuple[bool, float, str]:
    """Sort key: numbers by their size, then words."""
    number = isinstance(value, int | float) and math.isfinite(value)
    return (not number, float(value) if number else 0.0, str(value))
