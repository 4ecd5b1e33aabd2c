"""Maps for a GIS: the heights of a village beside the true ones, and layover and shadow over hills.

Run as `python docs/draw_maps.py`; it takes minutes. Writes docs/images/maps.png (384 × 384 pixels, preset `default`,
seed 0, images by ray casting; the hills are of random numbers).
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
import tifffile
import trimesh
from matplotlib.axes import Axes
from matplotlib.colors import LightSource, to_rgb
from scipy.ndimage import gaussian_filter

from sarsplat import Dataset, DatasetEntry, ImageGrid, Terrain, View, reconstruct, write_terrain
from sarsplat.colours import HEIGHT, colormap
from sarsplat.exports import export, export_terrain
from sarsplat.scenes.simulate import simulate_images
from sarsplat.scenes.village import village

PICTURE = Path(__file__).parent / "images" / "maps.png"
SIDE, PIXEL_M = 384, 0.3
HILLS, PITCH_M = 400, 5.0
SEEN_FROM = View(300.0, 40.0)
SUN = LightSource(azdeg=315, altdeg=40)


def shaded(ax: Axes, heights: np.ndarray, pixel_m: float, highest: float, title: str) -> None:
    """Draw heights as colours, lit from the upper left; white where unknown."""
    known = np.isfinite(heights)
    filled = np.where(known, heights, 0.0)
    rgb = SUN.shade(filled, colormap(HEIGHT), vmin=0, vmax=highest, dx=pixel_m, dy=pixel_m, blend_mode="soft")
    rgb[~known] = 1.0
    half_y, half_x = (pixel_m * count / 2 for count in heights.shape)
    ax.imshow(rgb, extent=(-half_x, half_x, -half_y, half_y))
    ax.set_title(title)
    ax.set_xlabel("x (m)")


def from_above(mesh: trimesh.Trimesh, left: float, top: float, shape: tuple[int, int], pixel_m: float) -> np.ndarray:
    """True heights in the middle of each pixel."""
    x, y = np.meshgrid(left + (np.arange(shape[1]) + 0.5) * pixel_m, top - (np.arange(shape[0]) + 0.5) * pixel_m)
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, mesh.bounds[1, 2] + 1)])
    down = np.tile([0.0, 0.0, -1.0], (x.size, 1))
    places, rays, _ = mesh.ray.intersects_location(origins, down, multiple_hits=False)
    heights = np.full(x.size, np.nan)
    heights[rays] = places[:, 2]
    return heights.reshape(shape)


def main() -> None:
    """Simulate, reconstruct, export, draw."""
    mesh, grid = village(0.64 * SIDE * PIXEL_M), ImageGrid(SIDE, SIDE, (PIXEL_M, PIXEL_M), (PIXEL_M, PIXEL_M))
    views = [View(azimuth, grazing) for grazing in (15.0, 45.0, 75.0) for azimuth in range(0, 360, 45)]
    entries = tuple(DatasetEntry(view, "train", f"{k:03}") for k, view in enumerate(views))
    run = reconstruct(Dataset(grid, entries, simulate_images(mesh, views, grid), target="village"), "default")
    noise = gaussian_filter(np.random.default_rng(5).normal(size=(HILLS, HILLS)), 18, mode="wrap")
    hills = Terrain(800 * (noise - noise.min()) / np.ptp(noise), (PITCH_M, PITCH_M))
    with TemporaryDirectory() as folder:
        export(run, Path(folder) / "dsm.tif")
        write_terrain(Path(folder) / "hills.tif", hills)
        export_terrain(Path(folder) / "hills.tif", Path(folder) / "classes.tif", SEEN_FROM)
        with tifffile.TiffFile(Path(folder) / "dsm.tif") as file:
            page = file.pages.first
            heights, (*_, left, top, _) = page.asarray(), page.tags[33922].value
        with tifffile.TiffFile(Path(folder) / "classes.tif") as file:
            classes = file.pages.first.asarray()
    truth = from_above(mesh, left, top, heights.shape, grid.cell_m)
    figure, axes = plt.subplots(1, 3, figsize=(16.5, 5.6), layout="constrained")
    shaded(axes[0], truth, grid.cell_m, float(np.nanmax(truth)), "the true heights of a village")
    shaded(axes[1], heights, grid.cell_m, float(np.nanmax(truth)), f"dsm.tif, from {len(views)} images")
    shaded(axes[2], hills.heights_m[::-1], PITCH_M, 800.0, "layover (red) and shadow (blue) from the upper right")
    extent = axes[2].images[0].get_extent()
    for bit, colour in ((2, "red"), (1, "blue")):
        over = np.zeros((*classes.shape, 4))
        over[(classes & bit) > 0] = (*to_rgb(colour), 0.45)
        axes[2].imshow(over, extent=extent)
    towards = np.array([-SEEN_FROM.look.ahead[0], -SEEN_FROM.look.ahead[1]]) * 0.42 * HILLS * PITCH_M
    axes[2].annotate("", 0.6 * towards, towards, arrowprops={"width": 3, "color": "black"})
    figure.savefig(PICTURE, dpi=75, facecolor="white", pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
