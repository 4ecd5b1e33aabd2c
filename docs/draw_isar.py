"""A satellite and an aircraft by inverse SAR: an unseen frame, and where the reconstructed points are.

Run as `python docs/draw_isar.py`, or with the other figures as `make figures`. Writes docs/images/isar.png (preset
`default`, seed 0, 24 frames about three axes, by ray casting).
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from sarsplat import Run, reconstruct
from sarsplat.cli.simulate import simulate
from sarsplat.cli.simulation_options import Isar, Options, Sensor, Target
from sarsplat.colours import HEIGHT, POWER, colormap
from sarsplat.evaluation import read_truth_mesh, visible_surface
from sarsplat.names import TargetName
from sarsplat.radiometry import DYNAMIC_RANGE_DB, to_db

PICTURE = Path(__file__).parent / "images" / "isar.png"
TARGETS: tuple[TargetName, ...] = ("satellite", "aircraft")
AXES = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
SIGHT = (1.0, 0.4, 0.6)
SHOWN = 60_000  # points drawn of a cloud
FROM = np.array([0.6, -0.45, 0.66])  # where it is looked at from


def show_frame(axes: tuple[Axes, Axes], run: Run) -> None:
    """The first unseen frame, true and ours, in decibels below the brightest pixel."""
    true, view = run.dataset.images("test")[0], run.dataset.select("test").views[0]
    for ax, image in zip(axes, (true, run.render([view])[0]), strict=True):
        level = to_db(image, true.max())
        ax.imshow(level, cmap=colormap(POWER), vmin=-DYNAMIC_RANGE_DB, vmax=0, interpolation="nearest")
        ax.set(xticks=[], yticks=[])


def show_points(ax: Axes, points: np.ndarray) -> None:
    """Points as seen from one side, the nearer before the farther, coloured by their height."""
    away = -FROM / np.linalg.norm(FROM)
    right = np.cross(away, [0, 0, 1]) / np.linalg.norm(np.cross(away, [0, 0, 1]))
    sample = np.random.default_rng(0).permutation(points)[:SHOWN]
    sample = sample[np.argsort(-sample @ away)]
    ax.scatter(
        *(sample @ right, sample @ np.cross(right, away), 0.6, sample[:, 2]),
        cmap=colormap(HEIGHT),
        linewidths=0,
        rasterized=True,
    )
    ax.set(aspect="equal")
    ax.axis("off")


def main() -> None:
    """Reconstruct and draw."""
    figure, axes = plt.subplots(len(TARGETS), 4, figsize=(15, 7), width_ratios=(0.8, 0.8, 1, 1), layout="constrained")
    for row, target in zip(axes, TARGETS, strict=True):
        with TemporaryDirectory() as folder:
            out = Path(folder) / target
            simulate(Options(out, target=Target(target), isar=Isar(AXES, SIGHT), sensor=Sensor((80,))))
            run = reconstruct(out)
            assert run.dataset.truth_mesh is not None  # it was simulated
            mesh = read_truth_mesh(run.dataset.truth_mesh)
            truth = visible_surface(mesh, run.dataset.select("train").views, 0.02, samples=SHOWN).samples
            show_frame((row[0], row[1]), run)
            show_points(row[2], truth)
            show_points(row[3], run.points)
        row[0].set_ylabel(target, fontsize=12)
    titles = "an unseen frame, true", "reconstructed", "the surface that frames show", "reconstructed points"
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=10)
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
