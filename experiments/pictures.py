"""Two unseen images and the points of every whole training of a group, below the truth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from experiment import Experiment
from jaxtyping import Bool

from sarsplat import Run
from sarsplat.colours import HEIGHT, POWER, colormap
from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter, shade
from sarsplat.sweeps.results import Result
from sarsplat.sweeps.work import RUNS

_RIM = 4  # pixels


def picture_of(experiment: Experiment, group: str) -> str:
    """Name of the file."""
    return f"{experiment.name.removesuffix('-chips')}-{'-'.join(re.findall(r'[a-z0-9]+', group.lower()))}.png"


def draw_groups(experiment: Experiment, results: Sequence[Result], work: Path, out: Path) -> None:
    """Draw the groups of which every whole training of the first seed is here; pictures of others stay as they are."""
    for group, rows in experiment.groups().items():
        wanted = {row.name: row.label for row in rows if not row.full}
        found = {one.cell.labels["part"]: one for one in reversed(results) if one.finished}
        shown = [(label, found[name]) for name, label in wanted.items() if name in found]
        if len(shown) == len(wanted):
            runs = [(label, work / RUNS / one.row.address) for label, one in shown if one.row is not None]
            out.mkdir(parents=True, exist_ok=True)
            _draw(runs, out / picture_of(experiment, group))


def _draw(shown: Sequence[tuple[str, Path]], path: Path) -> None:
    """A row for the truth and one for every run."""
    dataset = Run.load(shown[0][1]).dataset
    tests = [index for index, entry in enumerate(dataset.entries) if entry.split != "train"]
    chosen = [tests[len(tests) // 5], tests[3 * len(tests) // 5]]
    truth = dataset.power[chosen]
    part = _around(brighter(truth, -DYNAMIC_RANGE_DB))
    height, width = truth[0][part].shape
    figure, axes = plt.subplots(
        len(shown) + 1,
        3,
        figsize=(9, max(1.5, 2.5 * height / width) * (len(shown) + 1)),
        width_ratios=(1, 1, 1.6),
        layout="constrained",
    )
    runs = [(label, Run.load(folder)) for label, folder in shown]
    stacks = [(label, run.render([dataset.views[index] for index in chosen]), run.points) for label, run in runs]
    for row, (title, images, points) in zip(
        axes, [("truth: two unseen images, 40 dB", truth, np.empty((0, 3))), *stacks]
    ):
        for ax, image in zip(row, images):
            ax.imshow(shade(image[part], truth.max()), cmap=colormap(POWER), vmin=0, vmax=1)
            ax.set(xticks=[], yticks=[])
        row[0].set_title(title, fontsize=8, loc="left", pad=3)
        row[2].scatter(points[:, 0], points[:, 2], c=points[:, 1], s=0.3, cmap=colormap(HEIGHT), linewidths=0)
        row[2].set_aspect("equal")
        row[2].tick_params(labelsize=7)
    for ax in axes[1:, 2]:
        ax.sharex(axes[1, 2])
        ax.sharey(axes[1, 2])
    axes[0, 2].axis("off")
    axes[-1, 2].set_xlabel("x, m; z, m upwards; colour: y", fontsize=8)
    figure.savefig(path, dpi=90, facecolor="white", metadata={"Software": None}, pil_kwargs={"optimize": True})
    plt.close(figure)


def _around(bright: Bool[np.ndarray, "v rows columns"]) -> tuple[slice, slice]:
    """Rows and columns in which any of the images is bright, and some around them."""
    places = (np.flatnonzero(bright.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    rows, columns = (slice(max(0, int(there[0]) - _RIM), int(there[-1]) + 1 + _RIM) for there in places)
    return rows, columns
