"""Draw docs/images/sweep.gif: the radar goes round a reconstruction; its image beside the points, seen from the radar.

Run as `python docs/draw_sweep.py RUN` (`make sweep` after `make demo`).
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from sarsplat import Run, View, radar_frame
from sarsplat.colours import DARK, HEIGHT, POWER, colormap
from sarsplat.radiometry import DYNAMIC_RANGE_DB, to_db

OUTPUT = Path(__file__).parent / "images" / "sweep.gif"
GRAZING_DEG, FRAMES, FRAME_MS = 30.0, 60, 100
SHOWN_POINTS = 25_000


def frame(run: Run, view: View, power: np.ndarray, points: np.ndarray, reach_m: float) -> Image.Image:
    """One view: what the radar records, and what stands there."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.95), layout="constrained", facecolor=DARK.card)
    figure.get_layout_engine().set(h_pad=0.12)  # inches: titles stay clear of the edge
    decibels = to_db(power, run.brightest)
    left.imshow(decibels, cmap=colormap(POWER), vmin=-DYNAMIC_RANGE_DB, vmax=0, extent=run.grid.extent_m)
    left.set(xlim=(-reach_m, reach_m), ylim=(reach_m, -reach_m))
    left.set_title(f"SAR image, azimuth {view.azimuth_deg:3.0f}°", color=DARK.ink, fontsize=12)
    across, up, away = (points @ radar_frame(view).T).T
    order = np.argsort(-away)  # the near ones last
    right.scatter(across[order], up[order], c=points[order, 2], s=0.7, cmap=colormap(HEIGHT), linewidths=0)
    right.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), aspect="equal", facecolor=DARK.card)
    right.set_title("its points, from the radar", color=DARK.ink, fontsize=12)
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
    views = [View(azimuth, GRAZING_DEG) for azimuth in np.arange(FRAMES) * 360 / FRAMES]
    images = run.render(views)
    points = np.random.default_rng(0).permutation(run.points)[:SHOWN_POINTS]
    reach_m = 1.08 * float(np.linalg.norm(points, axis=1).max())
    frames = [frame(run, view, image, points, reach_m) for view, image in zip(views, images)]
    # one palette for all frames, or colours would flicker; few colours, no dithering: a megabyte
    few = np.concatenate([np.asarray(each) for each in frames[:: FRAMES // 4]])
    palette = Image.fromarray(few).quantize(96, dither=Image.Dither.NONE)
    first, *rest = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames)
    first.save(OUTPUT, save_all=True, append_images=rest, duration=FRAME_MS, loop=0, optimize=True)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
