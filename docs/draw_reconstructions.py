"""Three pictures for each built-in vehicle: an unseen view, where points are wrong, and what of the surface is missed.

Run as `python docs/draw_reconstructions.py`, or with the other figures as `make figures`. Writes
docs/images/reconstructions.png (preset `default`, seed 0, images by ray casting).
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from scipy.spatial import KDTree

from sarsplat import Run, View, reconstruct
from sarsplat.cli.simulate import simulate
from sarsplat.cli.simulation_options import Options, Target
from sarsplat.colours import ERROR, POWER, colormap
from sarsplat.evaluation import Yardstick, read_truth_mesh, visible_surface
from sarsplat.names import TargetName
from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter, to_db

PICTURE = Path(__file__).parent / "images" / "reconstructions.png"
VEHICLES: tuple[TargetName, ...] = ("t72", "btr70", "2s1", "kraz")
UNSEEN = View(120.0, 45.0)
FARTHEST_M = 0.2  # larger distances look alike
SAMPLES = 200_000
SHOWN = 40_000  # points drawn of a cloud


def show_images(axes: list[Axes], run: Run) -> None:
    """The true image and ours of an unseen view, where the target is, in decibels below the brightest pixel."""
    dataset = run.dataset
    test = dataset.select("test").views
    true, ours = dataset.images("test")[test.index(UNSEEN)], run.render([UNSEEN])[0]
    rows, columns = np.nonzero(brighter(true, -DYNAMIC_RANGE_DB))
    part = slice(rows.min() - 4, rows.max() + 5), slice(columns.min() - 4, columns.max() + 5)
    for ax, image in zip(axes, (true, ours), strict=True):
        level = to_db(image[part], true.max())
        ax.imshow(level, cmap=colormap(POWER), vmin=-DYNAMIC_RANGE_DB, vmax=0, interpolation="nearest")
        ax.set(xticks=[], yticks=[])


def show_distances(axes: list[Axes], points: np.ndarray, others: np.ndarray) -> PathCollection:
    """Points from the side and from above, coloured by how far each is from the others."""
    sample = np.random.default_rng(0).permutation(points)[:SHOWN]
    distance = KDTree(others).query(sample, workers=-1)[0]
    order = np.argsort(distance)  # largest errors on top
    for ax, up in zip(axes, (2, 1), strict=True):
        dots = ax.scatter(
            *(sample[order, 0], sample[order, up], 0.5, distance[order]),
            cmap=colormap(ERROR),
            vmin=0,
            vmax=FARTHEST_M,
            linewidths=0,
            rasterized=True,
        )
        ax.set(aspect="equal")
        ax.axis("off")
    return dots


def main() -> None:
    """Reconstruct and draw."""
    figure, axes = plt.subplots(
        len(VEHICLES), 6, figsize=(17, 7), width_ratios=(0.75, 0.75, 1, 1, 1, 1), layout="constrained"
    )
    for row, vehicle in zip(axes, VEHICLES, strict=True):
        with TemporaryDirectory() as folder:
            simulate(Options(Path(folder) / vehicle, target=Target(vehicle)))
            run = reconstruct(Path(folder) / vehicle)
            dataset = run.dataset
            rays_m = Yardstick.of(dataset.grid).ray_spacing_m
            assert dataset.truth_mesh is not None  # it was simulated
            mesh = read_truth_mesh(dataset.truth_mesh)
            surface = visible_surface(mesh, dataset.select("train").views, rays_m, samples=SAMPLES).samples
            show_images(row[:2], run)
            show_distances(row[2:4], run.points, surface)
            dots = show_distances(row[4:], surface, run.points)
        row[0].set_ylabel(vehicle, fontsize=12)
    view = f"azimuth {UNSEEN.azimuth_deg:g}°, grazing {UNSEEN.grazing_deg:g}°"
    for ax, title in zip(
        axes[0],
        (f"true, {view}", "reconstructed", "points: distance to the truth", "", "truth: distance to a point", ""),
        strict=True,
    ):
        ax.set_title(title, fontsize=10)
    figure.colorbar(dots, ax=axes[:, 2:], label="m", shrink=0.6, pad=0.01)
    figure.savefig(PICTURE, dpi=80, facecolor="white")


if __name__ == "__main__":
    main()
