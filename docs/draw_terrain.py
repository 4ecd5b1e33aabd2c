"""Draw a T-72 beside a hill, on level ground and on the hill's slope.

Run as `python docs/draw_terrain.py`, or with the other figures as `make figures`. Writes docs/images/terrain.png.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sarsplat import ImageGrid, ScatteringLaw, Terrain, View
from sarsplat.colours import POWER, colormap
from sarsplat.radiometry import to_db
from sarsplat.scenes import simulate_raycast, target_mesh

PICTURE = Path(__file__).parent / "images" / "terrain.png"
GRID = ImageGrid(100, 100, (0.25, 0.25), (0.3, 0.3))
VIEW, GROUND, RAYS_M = View(45.0, 30.0), 0.04, 0.04


def hill() -> Terrain:
    """A hill of 4 m, 9 m from the target, on a slope of 5°."""
    x, y = np.meshgrid(np.arange(-25, 25.5, 0.5), np.arange(-25, 25.5, 0.5))
    return Terrain(4 * np.exp(-((x - 2) ** 2 + (y - 9) ** 2) / 12) + 0.08 * x - 0.05 * y, (0.5, 0.5)).centred()


def main() -> None:
    figure, panels = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
    for axes, terrain, title in zip(panels, (None, hill()), ("level ground", "a hill on a slope"), strict=True):
        image = simulate_raycast(
            target_mesh("t72"), VIEW, GRID, ScatteringLaw(), ground_gamma0=GROUND, terrain=terrain, ray_spacing=RAYS_M
        )
        level = GROUND * np.tan(np.radians(VIEW.grazing_deg))
        axes.imshow(to_db(image, level), cmap=colormap(POWER), vmin=-15, vmax=20, interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=title)
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()
