"""Three vehicles on speckled ground: one of the images, the true surface, and the points from 24 such images.

Run as `python docs/draw_conditions.py`; it takes a minute. Writes docs/images/conditions.png (128 × 128 pixels of
0.3 m, one look, ground of γ⁰ = 0.05, settings chosen by the images, seed 0, images by ray casting).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import cast

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from draw_village import FARTHEST_M, SEEN_FROM, show
from scipy.spatial import KDTree

from sarsplat import Dataset, DatasetEntry, ImageGrid, View, reconstruct
from sarsplat.colours import ERROR, HEIGHT, POWER, colormap
from sarsplat.evaluation import Yardstick, visible_surface
from sarsplat.radiometry import to_db
from sarsplat.scenes.scattering import add_speckle
from sarsplat.scenes.simulate import simulate_images

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "experiments"))
from made_scenes import SCENES  # noqa: E402

PICTURE = HERE / "images" / "conditions.png"
GRID = ImageGrid(128, 128, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 30)]

SHOWN_VIEW = VIEWS.index(View(SEEN_FROM.azimuth_deg, 35.0))
SHOWN_DB = (-25.0, 10.0)
SAMPLES, SHOWN = 500_000, 150_000


def main() -> None:
    """Simulate, reconstruct, draw."""
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(SCENES["three vehicles"][1]()))
    power = add_speckle(simulate_images(mesh, VIEWS, GRID, ground_gamma0=0.05), 1, np.random.default_rng(0))
    entries = tuple(DatasetEntry(view, "train", f"{k:03}") for k, view in enumerate(VIEWS))
    run = reconstruct(Dataset(GRID, entries, power, target="three vehicles", looks=1.0, ground=True))
    surface = visible_surface(mesh, VIEWS, Yardstick.of(GRID).ray_spacing_m, samples=SAMPLES).samples
    chance = np.random.default_rng(0)
    surface, points = (chance.permutation(each)[:SHOWN] for each in (surface, run.points))
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained", width_ratios=(1, 1.2, 1.35))
    axes[0].imshow(to_db(power[SHOWN_VIEW]), cmap=colormap(POWER), vmin=SHOWN_DB[0], vmax=SHOWN_DB[1])
    axes[0].axis("off")
    axes[0].set_title(f"one of {len(VIEWS)} images: ground, one look")
    show(axes[1], surface, surface[:, 2], cmap=colormap(HEIGHT))
    axes[1].set_title("the surface that the radar sees")
    distance = KDTree(surface).query(points, workers=-1)[0]
    dots = show(axes[2], points, distance, cmap=colormap(ERROR), vmin=0, vmax=FARTHEST_M)
    axes[2].set_title("points")
    figure.colorbar(dots, ax=axes[2], label="distance from the surface (m)", shrink=0.7)
    figure.savefig(PICTURE, dpi=75, facecolor="white", pil_kwargs={"optimize": True})
    print(run.config.evidence)


if __name__ == "__main__":
    main()
