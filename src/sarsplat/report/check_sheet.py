"""A sheet of images with detected outlines and expected directions, to check for contradictions."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64

from sarsplat.colours import DARK, SHADOW, TARGET
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import bright_level
from sarsplat.regions.outlines import levels_db, outline
from sarsplat.report.look import Look
from sarsplat.report.sheet import arrow, decibel_bar, draw_image, new_sheet, to_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _FOOT, _TITLE = 2.4, 1.3, 0.3  # inches
_LINE, _TABLE_WIDTH = 0.17, 7.4  # of the table, inches
_MOST_COLUMNS = 4
_PLACES = (0.02, 0.32, 0.46, 0.57, 0.67, 0.82)  # left ends of the table's columns, relative to the sheet's width
_NOSE = 0.36  # length of the nose's arrow, relative to the shorter side of an image
_OF_THE_BRIGHTEST = "power, dB of the brightest 0.1 %"  # see `bright_level`
_LEGEND = (
    "Near range (row 0) is on top: the radar looks down along its arrow. Orange: detected target.{shadow}\n"
    "Dotted: where {x} points if the azimuth is right."
)
_SHADOW = " Blue: dark beside it; shadow should lie below the target."


def check_sheet(dataset: Dataset, most: int = 12, orientations: Sequence[tuple[str, ...]] = ()) -> bytes:
    """Draw at most `most` evenly chosen images of a dataset, with outlines of target and shadow and the nose, as PNG.

    `orientations` is a table to show below the images; see `Examination.orientations`.
    """
    if most < 1:
        raise SarsplatError(f"a sheet of {most} images cannot be drawn; ask for at least one")
    count = min(most, len(dataset))
    chosen = [k * len(dataset) // count for k in range(count)]
    power, grid = dataset.power[chosen], dataset.grid
    columns = min(count, _MOST_COLUMNS)
    lines = math.ceil(count / columns)
    aspect = grid.rows * grid.spacing_m[1] / (grid.columns * grid.spacing_m[0])
    above = _TITLE + _LINE * max(dataset.views[index].unusual.count(", ") for index in chosen)
    tall = min(max(_WIDTH * aspect, 0.8), 3 * _WIDTH)
    table = (len(orientations) + 1) * _LINE if orientations else 0.0
    foot = _FOOT + table
    width = max(columns * _WIDTH, _TABLE_WIDTH if orientations else 2 * _WIDTH)
    height = lines * (tall + above) + foot
    margins = {"left": 0.02, "right": 0.98, "top": 1 - above / height, "bottom": foot / height}
    figure, panels = new_sheet((width, height), lines, columns, **margins, wspace=0.06, hspace=above / tall)
    look = Look(bright_level(power))
    for axes, index, image, level in zip(panels, chosen, power, levels_db(power, grid, dataset.ground)):
        entry = dataset.entries[index]
        view = entry.view
        unusual = view.unusual.replace(", ", "\n")  # a line for each
        title = f"azimuth {view.azimuth_deg:.1f}°, grazing {view.grazing_deg:.1f}°{unusual}"
        draw_image(axes, image, grid, look, f"{title} ({entry.split})", 8)
        outlined = outline(level)
        _contour(axes, outlined.target, grid, TARGET)
        if dataset.ground:
            _contour(axes, outlined.shadow, grid, SHADOW)
        _nose(axes, entry.view, grid)
    decibel_bar(figure, (0.03, (foot - 0.22) / height, 2.6 / width, 0.08 / height), look, _OF_THE_BRIGHTEST)
    wide, high = grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1]
    legend = _LEGEND.format(shadow=_SHADOW if dataset.ground else "", x=_x_of(dataset))
    text = (
        f"{legend}\n{dataset.target}: {count} of {len(dataset)} images, "
        f"{wide:.3g} m of azimuth × {high:.3g} m of slant range."
    )
    size = 8 if columns > 2 or orientations else 6
    figure.text(0.02, (0.1 + table) / height, text, color=DARK.muted, size=size, va="bottom", linespacing=1.35)
    _table(figure, orientations)
    return to_png(figure)


def _x_of(dataset: Dataset) -> str:
    """Name of the direction of +x."""
    if dataset.place is None:
        return "the target's +x (of a vehicle its nose)"
    return f"+x (compass bearing {dataset.place.x_towards_deg:.4g}°)"


def _table(figure: "Figure", rows: Sequence[tuple[str, ...]]) -> None:
    """Write rows of text at the foot of the sheet; the best orientation is highlighted."""
    height = figure.get_size_inches()[1]
    for line, row in enumerate(reversed(rows)):
        colour = TARGET if "best" in row[-1] else DARK.ink if line == len(rows) - 1 else DARK.muted
        for place, text in zip(_PLACES, row, strict=True):
            figure.text(place, (0.1 + line * _LINE) / height, text, color=colour, size=8, va="bottom")


def _contour(axes: "Axes", mask: Bool[np.ndarray, "rows columns"], grid: ImageGrid, colour: str) -> None:
    if mask.any() and not mask.all() and min(mask.shape) > 1:
        axes.contour(grid.azimuth_m, grid.range_m, mask.astype(float), levels=[0.5], colors=[colour], linewidths=1.1)


def _nose(axes: "Axes", view: View, grid: ImageGrid) -> None:
    """Draw the direction of the nose from the middle of an image."""
    left, right, bottom, top = grid.extent_m
    nose: Float64[np.ndarray, " 2"] = view.look.gradients[:, 0] * _NOSE * min(right - left, bottom - top)
    middle = grid.center_m
    end = (middle[0] + float(nose[0]), middle[1] + float(nose[1]))
    arrow(axes, middle, end, ":")
