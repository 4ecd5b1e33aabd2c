"""Draw houses as the radar sees them from two sides, geocoded, and resampled to azimuth and range by an import.

Run as `python docs/draw_geocoded.py`, or with the other figures as `make figures`. Writes docs/images/geocoded.png.
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import map_coordinates

from sarsplat import ImageGrid, ScatteringLaw, View, import_folder
from sarsplat.colours import POWER, colormap
from sarsplat.errors import SarsplatWarning
from sarsplat.radiometry import to_db
from sarsplat.scenes import simulate_raycast, village

PICTURE = Path(__file__).parent / "images" / "geocoded.png"
GRID = ImageGrid(220, 220, (0.4, 0.4), (0.6, 0.6))
BEARINGS, GRAZING_DEG, GROUND = (0.0, 50.0), 35.0, 0.05
SIDE, PITCH_M = 200, 0.4


def on_map(image: np.ndarray, bearing_deg: float) -> np.ndarray:
    """An image on level ground, north up, as a producer of geocoded images would make it."""
    east, north = np.meshgrid(*2 * [(np.arange(SIDE) - (SIDE - 1) / 2) * PITCH_M])
    bearing = np.radians(bearing_deg)
    away = np.sin(bearing) * east - np.cos(bearing) * north  # rows run south
    across = np.cos(bearing) * east + np.sin(bearing) * north
    rows = -away * np.cos(np.radians(GRAZING_DEG)) / GRID.spacing_m[1] + (GRID.rows - 1) / 2
    columns = across / GRID.spacing_m[0] + (GRID.columns - 1) / 2
    return np.maximum(map_coordinates(image, [rows, columns], order=3), 1e-5)


def main() -> None:
    mesh, titles = village(30.0, seed=1), ("as the radar sees it", "geocoded, north up", "resampled by the import")
    figure, panels = plt.subplots(2, 3, figsize=(9, 6), layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        images, rows = [], ["file,azimuth,grazing"]
        for number, bearing in enumerate(BEARINGS):
            view = View(bearing - 90, GRAZING_DEG)  # x points east
            image = simulate_raycast(mesh, view, GRID, ScatteringLaw(), ground_gamma0=GROUND, ray_spacing=0.1)
            images.append((image, on_map(image, bearing)))
            np.save(f"{folder}/{number}.npy", images[-1][1])
            rows.append(f"{number}.npy,{bearing},{GRAZING_DEG}")
        Path(folder, "table.csv").write_text("\n".join(rows))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SarsplatWarning)  # of two views
            made = import_folder(
                folder, f"{folder}/out", quantity="power", spacing_m=(PITCH_M, PITCH_M), resolution_m=GRID.resolution_m,
                geocoded="level", looks=None, calibration="absolute",
            )  # fmt: skip
    half = made.grid.columns * made.grid.spacing_m[0] / 2
    for line, (radar, geocoded), back in zip(panels, images, made.power, strict=True):
        grids = (GRID.extent_m, (-SIDE * PITCH_M / 2, SIDE * PITCH_M / 2) * 2, made.grid.extent_m)
        for axes, image, extent, title in zip(line, (radar, geocoded, back), grids, titles, strict=True):
            level = GROUND * np.tan(np.radians(GRAZING_DEG))
            axes.imshow(to_db(image, level), cmap=colormap(POWER), vmin=-15, vmax=20, extent=extent, aspect="auto")
            height = half if title == titles[1] else -half * np.cos(np.radians(GRAZING_DEG))
            axes.set(xticks=[], yticks=[], xlim=(-half, half), ylim=(-height, height))
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(title)
    for line, bearing in zip(panels, BEARINGS, strict=True):
        line[0].set_ylabel(f"radar in the {'north' if bearing == 0 else 'north-east'}")
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()
