"""Draw docs/images/sweep.gif: the radar goes round a reconstruction; its image beside the surface, seen from the radar.

Run as `python docs/draw_sweep.py RUN` (`make sweep` after `make demo`).
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from sarsplat import Run, View, radar_frame
from sarsplat.colours import DARK, HEIGHT, POWER, colormap, ramp, rgb
from sarsplat.radiometry import DYNAMIC_RANGE_DB, to_db
from sarsplat.report.boards import Raster, Side, Sight
from sarsplat.report.rendered import asked_grid

OUTPUT = Path(__file__).parent / "images" / "sweep.gif"
GRAZING_DEG, FRAMES, FRAME_MS = 30.0, 60, 100
FINER = 3  # pixels of the rendering along a pixel of the training images
LIGHT, AMBIENT = np.array([-0.45, 0.65, -0.6]), 0.45  # towards the light in the radar frame, and in the dark
PIXELS, WIDTH = 760, 0.2  # of the surface's picture, drawn half as large; of a point, in resolution cells
FROM_THE_RADAR = Side("radar", 0, 1, 2, -1)  # azimuth to the right, elevation upwards, the nearest point in front


def surface(run: Run, points: np.ndarray, normals: np.ndarray, view: View) -> np.ndarray:
    """Points as the radar sees them, coloured by height and lit from beside it: RGB [pixels, pixels, 3]."""
    frame = radar_frame(view)
    middle, reach_m = bounds(points)
    raster = Raster(frame @ middle - reach_m, frame @ middle + reach_m, 2 * reach_m / PIXELS)
    width = max(1, round(WIDTH * run.grid.cell_m / raster.pixel_m))
    sight = Sight(raster, FROM_THE_RADAR, width)
    sight.add(0, (points @ frame.T).T)
    seen = sight.seen
    lit = AMBIENT + (1 - AMBIENT) * np.clip(normals @ frame.T @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    height = np.clip(points[:, 2] / np.quantile(points[:, 2], 0.999), 0, 1)
    colours = ramp(HEIGHT)[np.rint(255 * height).astype(int), :3] * lit[:, None]
    shown = np.full((*seen.shape, 3), rgb(DARK.card), np.uint8)
    shown[seen >= 0] = colours[seen[seen >= 0]].astype(np.uint8)
    return np.asarray(Image.fromarray(shown).resize((PIXELS // 2, PIXELS // 2), Image.Resampling.BOX))


def bounds(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The middle of the target, and how far from there all of it lies, m."""
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    return (low + high) / 2, 1.03 * float(np.linalg.norm(high - low)) / 2


def drawn(run: Run, points: np.ndarray, normals: np.ndarray, view: View) -> Image.Image:
    """One view: the radar image and the scene."""
    spacing_m = run.grid.spacing_m[0] / FINER
    grid = asked_grid(run.grid, None, spacing_m, None)
    decibels = to_db(run.render([view], grid)[0], run.brightest)
    layout = ConstrainedLayoutEngine(h_pad=0.12)  # inches: titles stay clear of the edge
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.95), layout=layout, facecolor=DARK.card)
    levels = {"cmap": colormap(POWER), "vmin": -DYNAMIC_RANGE_DB, "vmax": 0}
    left.imshow(decibels, extent=grid.extent_m, interpolation="bicubic", **levels)
    middle, reach_m = bounds(points)
    azimuth, _, slant_range = radar_frame(view) @ middle
    left.set(xlim=(azimuth - reach_m, azimuth + reach_m), ylim=(slant_range + reach_m, slant_range - reach_m))
    left.set_title(f"SAR image, azimuth {view.azimuth_deg:3.0f}°", color=DARK.ink, fontsize=12)
    right.imshow(surface(run, points, normals, view))
    right.set_title("its surface, from the radar", color=DARK.ink, fontsize=12)
    for ax in (left, right):
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    return picture(figure)


def picture(figure: Figure) -> Image.Image:
    """A figure in memory."""
    file = io.BytesIO()
    figure.savefig(file, dpi=100, facecolor=DARK.card, format="png")
    plt.close(figure)
    return Image.open(file).convert("RGB")


def main() -> None:
    """Write the animation."""
    if len(sys.argv) != 2:
        sys.exit("usage: python docs/draw_sweep.py RUN")
    run = Run.load(Path(sys.argv[1]))
    points, normals = run.points, run.normals
    views = [View(azimuth, GRAZING_DEG) for azimuth in np.arange(FRAMES) * 360 / FRAMES]
    frames = [drawn(run, points, normals, view) for view in views]
    # one palette for all frames, or colours would flicker; few colours, no dithering: a megabyte
    few = np.concatenate([np.asarray(each) for each in frames[:: FRAMES // 4]])
    palette = Image.fromarray(few).quantize(96, dither=Image.Dither.NONE)
    first, *rest = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames)
    first.save(OUTPUT, save_all=True, append_images=rest, duration=FRAME_MS, loop=0, optimize=True)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
