"""A sheet of images with what was detected in them and how they are meant to lie, to look for contradictions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.reconstruction.outlines import levels_db, outline
from sarsplat.report.canvas import BLUE, INK, MUTED, ORANGE, PANEL, dress, new_figure, to_png
from sarsplat.report.decibels import DYNAMIC_DB, to_decibels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH, _FOOT, _TITLE = 2.4, 0.75, 0.3  # inches
_MOST_COLUMNS = 4
_NOSE = 0.36
"""Length of the nose's arrow on the ground, of the shorter side of the images."""

_PLATE: dict[str, Any] = {
    "size": 8,
    "ha": "left",
    "va": "center",
    "bbox": {"facecolor": PANEL, "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
}
"""Of words on an image, however bright that is."""

_LEGEND = (
    "Near range (row 0) is on top: the radar looks down along the arrow. Orange: detected target.{shadow}\n"
    "Dotted: where the target's +x (its nose) points if the azimuth is right."
)
_SHADOW = " Blue: dark beside it; shadow should lie below the target."


def check_sheet(dataset: Dataset, most: int = 12) -> bytes:
    """Evenly chosen images of a dataset with target and shadow outlined and directions marked, as PNG.

    Parameters
    ----------
    dataset : Dataset
        Its images.
    most : int
        Number of images at most.

    Raises
    ------
    SarsplatError
        If the number is not positive.
    """
    if most < 1:
        raise SarsplatError(f"a sheet of {most} images cannot be drawn; ask for at least one")
    count = min(most, len(dataset))
    chosen = [k * len(dataset) // count for k in range(count)]
    power, grid = dataset.power[chosen], dataset.grid
    columns = min(count, _MOST_COLUMNS)
    lines = math.ceil(count / columns)
    aspect = grid.rows * grid.spacing_m[1] / (grid.columns * grid.spacing_m[0])
    tall = min(max(_WIDTH * aspect, 0.8), 3 * _WIDTH)
    width, height = max(columns * _WIDTH, 2 * _WIDTH), lines * (tall + _TITLE) + _FOOT
    figure = new_figure(width, height)
    panels = figure.subplots(lines, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.02, right=0.98, top=1 - _TITLE / height, bottom=_FOOT / height, wspace=0.06, hspace=_TITLE / tall
    )
    peak = float(power.max()) or 1.0
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, index, image, level in zip(panels.flat, chosen, power, levels_db(power, grid, dataset.ground)):
        axes.imshow(
            to_decibels(image, peak),
            cmap="gray",
            vmin=-DYNAMIC_DB,
            vmax=0,
            extent=_extent(grid),
            interpolation="nearest",
        )
        found = outline(level)
        _contour(axes, found.target, grid, ORANGE)
        if dataset.ground:
            _contour(axes, found.shadow, grid, BLUE)
        entry = dataset.entries[index]
        _directions(axes, entry.view, grid)
        _scale_bar(axes, grid)
        dress(axes)
        view = entry.view
        angles = f"azimuth {view.azimuth_deg:.1f}°, grazing {view.grazing_deg:.1f}°"
        axes.set_title(f"{angles} ({entry.split})", size=8, pad=4)
    wide, high = grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1]
    legend = _LEGEND.format(shadow=_SHADOW if dataset.ground else "")
    text = (
        f"{legend}\n{dataset.target}: {count} of {len(dataset)} images, "
        f"{wide:.3g} m of azimuth × {high:.3g} m of slant range; {DYNAMIC_DB:g} dB from black to white."
    )
    figure.text(0.02, 0.1 / height, text, color=MUTED, size=8 if columns > 2 else 6, va="bottom", linespacing=1.35)
    return to_png(figure)


def _extent(grid: ImageGrid) -> tuple[float, float, float, float]:
    half_azimuth, half_range = grid.spacing_m[0] / 2, grid.spacing_m[1] / 2
    return (
        grid.azimuth_m[0] - half_azimuth,
        grid.azimuth_m[-1] + half_azimuth,
        grid.range_m[-1] + half_range,
        grid.range_m[0] - half_range,
    )


def _contour(axes: Axes, mask: Bool[np.ndarray, "rows columns"], grid: ImageGrid, colour: str) -> None:
    if mask.any() and not mask.all() and min(mask.shape) > 1:
        axes.contour(grid.azimuth_m, grid.range_m, mask.astype(float), levels=[0.5], colors=[colour], linewidths=1.1)


def _directions(axes: Axes, view: View, grid: ImageGrid) -> None:
    """The radar's line of sight at the left, and the nose from the middle."""
    left, right, bottom, top = _extent(grid)
    high = bottom - top
    x = left + 0.07 * (right - left)
    start, end = (x, top + 0.1 * high), (x, top + 0.32 * high)
    _arrow(axes, start, end, INK, "-")
    axes.text(x, top + 0.04 * high, "radar", **_PLATE, color=INK)
    axes.text(x, bottom - 0.04 * high, "far", **_PLATE, color=INK)
    nose: Float64[np.ndarray, " 3"] = radar_frame(view)[:, 0] * _NOSE * min(right - left, high)
    middle = grid.center_m
    _arrow(axes, middle, (middle[0] + float(nose[0]), middle[1] + float(nose[2])), INK, ":")


def _scale_bar(axes: Axes, grid: ImageGrid) -> None:
    """A round length along azimuth, a fifth of the image or more, at the bottom on the right."""
    left, right, bottom, top = _extent(grid)
    unit = 10 ** math.floor(math.log10(0.4 * (right - left)))
    length = unit * max(round_ for round_ in (1, 2, 4) if round_ * unit <= 0.4 * (right - left))
    end, y = right - 0.05 * (right - left), bottom - 0.04 * (bottom - top)
    axes.plot([end - length, end], [y, y], color=INK, linewidth=1.5, scalex=False, scaley=False)
    axes.text(end, y - 0.04 * (bottom - top), f"{length:g} m", **{**_PLATE, "ha": "right"}, color=INK)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str, style: str) -> None:
    properties = {"arrowstyle": "->", "color": colour, "linestyle": style, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=end, xytext=start, arrowprops=properties)
