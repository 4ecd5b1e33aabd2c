"""A parking lot from measured phase history, and how sharp a calibration target is in it.

Run as `python docs/draw_gotcha.py FILES`, with the files of azimuths 1° to 4° of AFRL's GOTCHA, pass 1, HH. Writes
docs/images/gotcha.png and prints what docs/reference/formats/phase-history.md says of the target.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from PIL import Image

from sarsplat.colours import POWER, colormap
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import UNIFORM, Taylor
from sarsplat.importers.history_gotcha import read_gotcha
from sarsplat.importers.phase_apertures import Aperture, apertures
from sarsplat.importers.phase_history import flights
from sarsplat.importers.phase_history_images import focus
from sarsplat.radiometry import to_db

PICTURE = Path(__file__).parent / "images" / "gotcha.png"
ROWS, COLUMNS, SPACING = 400, 520, 0.18  # m: a little less than the resolution
TARGET = (-21.6, 10.6)  # azimuth and slant range of the brightest reflector, m
STEP, REACH = 0.01, 3.0  # m, of the cuts through it
DECIBELS = (-2, 36)  # about the median of the picture


def main(files: list[str]) -> None:
    """Draw the image and the cuts."""
    (flight,) = flights([read_gotcha(path) for path in files])
    (aperture,) = apertures(flight, np.zeros(3), None)
    figure = plt.figure(figsize=(12, 6.4), layout="constrained")
    ((left, right),) = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.2, 1))
    draw_image(left.subplots(), aperture)
    for axes, along in zip(right.subplots(2, sharey=True), ("azimuth", "range"), strict=True):
        for name, weighting, colour in (("uniform", UNIFORM, "tab:gray"), ("taylor", Taylor(), "tab:blue")):
            draw_cut(axes, aperture, name, weighting, along, colour)
    figure.savefig(PICTURE, dpi=100)
    few = Image.open(PICTURE).convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE, colors=48)
    few.save(PICTURE, optimize=True)


def draw_image(axes: Axes, aperture: Aperture) -> None:
    """The lot, in decibels."""
    grid = ImageGrid(ROWS, COLUMNS, (SPACING, SPACING), aperture.resolution_m(Taylor()))
    power = np.abs(focus(aperture, grid, Taylor())) ** 2
    extent = (grid.azimuth_m[0], grid.azimuth_m[-1], grid.range_m[-1], grid.range_m[0])
    level = to_db(power, np.median(power))
    axes.imshow(level, cmap=colormap(POWER), extent=extent, vmin=DECIBELS[0], vmax=DECIBELS[1])
    axes.add_patch(Circle(TARGET, 3, fill=False, color="tab:blue"))
    axes.set(xlabel="azimuth, m", ylabel="slant range, m")


def draw_cut(axes: Axes, aperture: Aperture, name: str, weighting: Taylor, along: str, colour: str) -> None:
    """A line through the target beside theory; its width and highest side lobe are printed."""
    which = ("azimuth", "range").index(along)
    resolution = aperture.resolution_m(weighting)
    place, power = cut(aperture, weighting, which)
    theory = weighting.density(place / resolution[which]) / weighting.density(np.zeros(1))
    axes.plot(place, to_db(power), color=colour, label=name)
    axes.plot(place, to_db(theory + 1e-18), ":", color=colour)
    axes.set(ylim=(-45, 1), xlim=(-REACH, REACH), xlabel=f"{along}, m", ylabel="dB")
    axes.legend(frameon=False)
    print(
        f"{along:8}{name:8} width {width(place, power):.3f} m (theory {resolution[which]:.3f}), "
        f"side lobe {side_lobe(power):.1f} dB (theory {side_lobe(theory):.1f})"
    )


def cut(aperture: Aperture, weighting: Taylor, along: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the target along azimuth (0) or range (1), and power, 1 at its peak."""
    centre = TARGET
    for axis in (0, 1, 0, 1, along):
        shape = (1, 1 + 2 * round(REACH / STEP))
        rows, columns = shape if axis == 0 else shape[::-1]
        grid = ImageGrid(rows, columns, (STEP, STEP), aperture.resolution_m(weighting), centre)
        power = np.abs(focus(aperture, grid, weighting).ravel()) ** 2
        place = grid.azimuth_m if axis == 0 else grid.range_m
        peak = place[power.argmax()]
        centre = (peak, centre[1]) if axis == 0 else (centre[0], peak)
    return place - peak, power / power.max()


def width(place: np.ndarray, power: np.ndarray) -> float:
    """Width of the main lobe above half its peak."""
    half = np.flatnonzero(power >= 0.5)
    first, last = half[0], half[-1]
    left = np.interp(0.5, power[[first - 1, first]], place[[first - 1, first]])
    return float(np.interp(0.5, power[[last + 1, last]], place[[last + 1, last]]) - left)


def side_lobe(power: np.ndarray) -> float:
    """The highest beyond the first minima, dB below the peak."""
    peak = int(power.argmax())
    sides = (power[peak:], power[peak::-1])
    return float(to_db(max(side[int(np.argmax(np.diff(side) > 0)) :].max() for side in sides)))


if __name__ == "__main__":
    main(sys.argv[1:])
