"""Fill the README's results from a run: its table, between two markers, and docs/images/demo.png.

Run as `make readme` after `make demo`, or as `python docs/readme_results.py RUN`.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from matplotlib.axes import Axes

from sarsplat import Run, View
from sarsplat.colours import HEIGHT, POWER, colormap
from sarsplat.evaluation import Yardstick, comparison, metrics_of_points, paper_scores, summary_metrics, visible_surface
from sarsplat.radiometry import DYNAMIC_RANGE_DB, to_db
from sarsplat.runs.run_folder import Metrics

HERE = Path(__file__).parent
README, PICTURE = HERE.parent / "README.md", HERE / "images" / "demo.png"
BLOCK = re.compile(r"(<!-- results: begin[^>]*-->\n).*?(<!-- results: end -->)", re.DOTALL)

SHOWN = (View(30.0, 75.0), View(120.0, 45.0), View(210.0, 15.0))  # unseen views, one at each grazing angle
CROP = 40  # pixels left out on every side
SHOWN_POINTS = 40_000  # of either cloud: a denser one would only look more solid


def table(metrics: Metrics) -> str:
    """The scores of a run with one test set, as Markdown."""
    yardstick = Yardstick(metrics["parameters"]["yardstick_m"])
    points = {metric.key for metric in metrics_of_points(yardstick)}
    methods = comparison(metrics, paper_scores("T72"))
    lines = [
        f"| | sarsplat, `make demo`, {os.cpu_count()} CPU cores | SAR-GS paper, T72, RTX 3060 Ti |",
        "|---|---:|---:|",
    ]
    for metric in summary_metrics(methods, yardstick):
        name = f"{metric.label}, visible surface" if metric.key in points else metric.label
        measure = ", ".join(filter(None, (metric.unit, metric.arrow)))
        values = " | ".join(metric.text(method.values.get(metric.key)) for method in methods)
        lines.append(f"| {name} ({measure}) | {values} |")
    return "\n".join(lines) + "\n"


def draw(run: Run) -> None:
    """True and reconstructed: three unseen views, and the surface from two sides."""
    dataset = run.dataset
    test = dataset.select("test").views
    chosen = [test.index(view) for view in SHOWN]
    truth = dataset.images("test")[chosen]
    rendered = run.render([test[k] for k in chosen])
    mesh = trimesh.load_mesh(dataset.truth_mesh, process=False)
    rays_m = Yardstick.of(dataset.grid).ray_spacing_m
    surface = visible_surface(mesh, dataset.select("train").views, rays_m).samples

    figure, axes = plt.subplots(2, 5, figsize=(15, 4.6), width_ratios=(1, 1, 1, 1.45, 1.45), layout="constrained")
    peak = float(dataset.images("train").max())
    for row, (name, images, points) in enumerate((("truth", truth, surface), ("sarsplat", rendered, run.points))):
        for ax, image, view in zip(axes[row], images, SHOWN):
            show_image(ax, image, peak, dataset.grid.spacing_m)
            if row == 0:
                ax.set_title(f"azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}°", fontsize=10)
        axes[row, 0].set_ylabel(name, fontsize=13)
        show_points(axes[row, 3], points, (0, 2))
        show_points(axes[row, 4], points, (0, 1))
    axes[0, 3].set_title("surface, from the side", fontsize=10)
    axes[0, 4].set_title("surface, from above", fontsize=10)
    figure.savefig(PICTURE, dpi=100, facecolor="white")


def show_image(ax: Axes, power: np.ndarray, peak: float, spacing: tuple[float, float]) -> None:
    """The middle of a β⁰ image in decibels below the set's brightest pixel."""
    decibels = to_db(power[CROP:-CROP, CROP:-CROP], peak)
    ax.imshow(
        decibels,
        cmap=colormap(POWER),
        vmin=-DYNAMIC_RANGE_DB,
        vmax=0,
        interpolation="nearest",
        aspect=spacing[1] / spacing[0],
    )
    ax.set(xticks=[], yticks=[])


def show_points(ax: Axes, points: np.ndarray, axes: tuple[int, int]) -> None:
    """Points on one of the world's planes, the nearer ones on top, coloured by height."""
    (hidden,) = {0, 1, 2} - set(axes)
    points = np.random.default_rng(0).permutation(points)[:SHOWN_POINTS]
    order = np.argsort(points[:, hidden] * (-1 if hidden == 1 else 1))  # seen from −y, or from above
    x, y = points[order][:, axes[0]], points[order][:, axes[1]]
    ax.scatter(x, y, c=points[order, 2], s=0.8, cmap=colormap(HEIGHT), vmin=0, vmax=2.5, linewidths=0, rasterized=True)
    ax.set(aspect="equal", xlim=(-3.7, 6.3), ylim=(-0.2, 3.2) if axes[1] == 2 else (-2.2, 2.2))
    ax.axis("off")


def main() -> None:
    """Rewrite the README's block and the picture."""
    if len(sys.argv) != 2:
        sys.exit("usage: python docs/readme_results.py RUN")
    run = Run.load(Path(sys.argv[1]))
    if run.metrics is None:
        sys.exit(f"{run.path} has no metrics.json; run `sarsplat evaluate {run.path}` first")
    text = README.read_text(encoding="utf-8")
    if not BLOCK.search(text):
        sys.exit(f"{README} has no results block to fill: <!-- results: begin … --> … <!-- results: end -->")
    block = table(run.metrics)
    README.write_text(BLOCK.sub(lambda match: match[1] + block + match[2], text), encoding="utf-8")
    draw(run)


if __name__ == "__main__":
    main()
