"""A village from 24 images: its true surface, and the points, coloured by how far they are from it.

Run as `python docs/draw_village.py`; it takes minutes. Writes docs/images/village.png (512 × 512 pixels, preset
`quick`, seed 0, images by ray casting, no ground).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from scipy.spatial import KDTree

from sarsplat import Dataset, DatasetEntry, ImageGrid, View, reconstruct
from sarsplat.colours import ERROR, HEIGHT, colormap
from sarsplat.evaluation import Yardstick, visible_surface
from sarsplat.scenes.simulate import simulate_images
from sarsplat.scenes.village import village

PICTURE = Path(__file__).parent / "images" / "village.png"
SIDE, PIXEL_M = 512, 0.3
SHOWN = 150_000  # points drawn of a cloud
SAMPLES = 3_000_000  # of the surface, closer together than the points are wrong
FARTHEST_M = 0.3  # larger distances look alike
SEEN_FROM = View(30.0, 40.0)


def show(ax: Axes, places: np.ndarray, colour: np.ndarray, **how: Any) -> PathCollection:
    """Draw places as seen from `SEEN_FROM`, nearer ones on top."""
    azimuth, grazing = np.radians([SEEN_FROM.azimuth_deg, SEEN_FROM.grazing_deg])
    towards, right = np.array([np.cos(azimuth), -np.sin(azimuth)]), np.array([np.sin(azimuth), np.cos(azimuth)])
    near, across = places[:, :2] @ towards, places[:, :2] @ right
    order = np.argsort(near * np.cos(grazing) + places[:, 2] * np.sin(grazing))
    up = places[:, 2] * np.cos(grazing) - near * np.sin(grazing)
    ax.set(aspect="equal")
    ax.axis("off")
    return ax.scatter(across[order], up[order], 0.4, colour[order], linewidths=0, rasterized=True, **how)


def main() -> None:
    """Simulate, reconstruct, draw."""
    mesh, grid = village(0.64 * SIDE * PIXEL_M), ImageGrid(SIDE, SIDE, (PIXEL_M, PIXEL_M), (PIXEL_M, PIXEL_M))
    views = [View(azimuth, grazing) for grazing in (15.0, 45.0, 75.0) for azimuth in range(0, 360, 45)]
    entries = tuple(DatasetEntry(view, "train", f"{k:03}") for k, view in enumerate(views))
    run = reconstruct(Dataset(grid, entries, simulate_images(mesh, views, grid), target="village"), "quick")
    surface = visible_surface(mesh, views, Yardstick.of(grid).ray_spacing_m, samples=SAMPLES).samples
    points = np.random.default_rng(0).permutation(run.points)[:SHOWN]
    figure, axes = plt.subplots(1, 2, figsize=(15, 5.6), layout="constrained")
    show(axes[0], surface[:SHOWN], surface[:SHOWN, 2], cmap=colormap(HEIGHT))
    distance = KDTree(surface).query(points, workers=-1)[0]
    dots = show(axes[1], points, distance, cmap=colormap(ERROR), vmin=0, vmax=FARTHEST_M)
    axes[0].set_title("the surface that the radar sees")
    axes[1].set_title(f"points from {len(views)} images")
    figure.colorbar(dots, ax=axes[1], label="distance from the surface (m)", shrink=0.7)
    figure.savefig(PICTURE, dpi=75, facecolor="white", pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
