"""One experiment as a picture: a panel for every judged metric, ours with the seeds' spread, the paper's beside it."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from experiment import Experiment
from matplotlib.axes import Axes
from metrics import METRIC
from summary import Line

_COLOURS = ("#4878a8", "#6a9f58", "#b8860b", "#7a5195")
_PAPER = "#c0392b"

_LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value beyond which their axis is logarithmic."""


def draw(experiment: Experiment, finished: list[Line], path: Path) -> None:
    """Draw what is finished.

    Parameters
    ----------
    experiment : Experiment
        What is drawn.
    finished : list of Line
        Its rows.
    path : pathlib.Path
        PNG to write.
    """
    numbers = all(line.row.x is not None for line in finished)
    height = 3.6 if numbers else 1.4 + 0.24 * len(finished)
    count = len(experiment.judged)
    figure, axes = plt.subplots(1, count, figsize=(4.5 * count, height), squeeze=False, layout="constrained")
    for panel, (ax, key) in enumerate(zip(axes[0], experiment.judged, strict=True)):
        (_against_x if numbers else _row_by_row)(ax, experiment, finished, key)
        if not numbers and panel:
            ax.set_yticklabels([])
        ax.grid(alpha=0.25)
        ax.margins(0.08)
    if axes[0, 0].get_legend_handles_labels()[1]:
        axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=90, facecolor="white", metadata={"Software": None}, pil_kwargs={"optimize": True})
    plt.close(figure)


def _against_x(ax: Axes, experiment: Experiment, finished: list[Line], key: str) -> None:
    """Lines over the number that changes, one for each group."""
    for colour, group in zip(_COLOURS, experiment.groups()):
        members = [line for line in finished if line.row.group == group and key in line.spreads]
        spreads = [line.spreads[key] for line in members]
        if members:
            means, sds = [spread.mean for spread in spreads], [spread.sd or 0.0 for spread in spreads]
            xs = np.array([line.row.x for line in members], float)
            ax.errorbar(xs, means, sds, fmt="o-", ms=4, capsize=3, color=colour, label=group.replace("`", "") or "ours")
    published = [(line.row.x, line.row.paper[key]) for line in finished if key in line.row.paper]
    if published:
        ax.plot(*zip(*published, strict=True), "s--", ms=4, color=_PAPER, mfc="none", label="paper")
    ax.set(xlabel=experiment.axis, ylabel=METRIC[key].title)


def _row_by_row(ax: Axes, experiment: Experiment, finished: list[Line], key: str) -> None:
    """A dot for every row, from top to bottom."""
    several = len(experiment.groups()) > 1
    names = [
        f"{line.row.group}: {line.row.label}" if several and line.row.group else line.row.label for line in finished
    ]
    colours = {group: _COLOURS[k % len(_COLOURS)] for k, group in enumerate(experiment.groups())}
    for y, line in enumerate(finished):
        if key in line.spreads:
            spread = line.spreads[key]
            ax.errorbar(spread.mean, y, xerr=spread.sd or 0.0, fmt="o", ms=4, capsize=3, color=colours[line.row.group])
        if key in line.row.paper:
            label = "paper" if all(key not in above.row.paper for above in finished[:y]) else None
            ax.plot(line.row.paper[key], y, "s", ms=5, color=_PAPER, mfc="none", label=label)
    ax.set_yticks(range(len(finished)), [name.replace("`", "") for name in names], fontsize=8)
    ax.set_ylim(len(finished) - 0.5, -0.5)
    means = [line.spreads[key].mean for line in finished if key in line.spreads]
    if means and min(means) > 0 and max(means) > _LOGARITHMIC * min(means):
        ax.set_xscale("log")
    ax.set_xlabel(fill(METRIC[key].title, 30))  # beside long names panels are narrow
