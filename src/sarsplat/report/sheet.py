"""Sheets of images: contact sheets and check sheets, and maps of views on the sky."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64, Real

from sarsplat.arguments import checks_arguments
from sarsplat.colours import DARK, SHADOW, TARGET, colormap
from sarsplat.data import Dataset
from sarsplat.data.coverage import largest_gap
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import bright_level, to_db
from sarsplat.regions.outlines import levels_db, outline
from sarsplat.report.figure import scale_bar
from sarsplat.report.images import Look, block_means, target_window
from sarsplat.report.views import evenly

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIDE, _LINE = 1.6, 0.13  # inches
_MAX_COLUMNS = 8
_MOST = 12 * _MAX_COLUMNS  # images: more would not fit on a screen
_TEXT = 7.5  # points
_PIXELS = 512  # maximum of an image's shorter side on the sheet
_EDGE = 0.05  # margin of annotations, relative to an image
_PLATE: dict[str, Any] = {"facecolor": DARK.card, "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
"""Background of text on an image."""


@checks_arguments
def contact_sheet(
    images: Real[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid, look: Look
) -> bytes:
    """Draw all images in decibels, cropped to the target, with view, scale and radar, as PNG.

    Parameters
    ----------
    images : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    views, grid
        Of the images.
    look : Look
        Levels and colours, as of the single pictures.

    Raises
    ------
    SarsplatError
        If there are no images.

    Notes
    -----
    At most 96 images are shown, evenly spaced in their order; the sheet says so.
    """
    if len(images) == 0:
        raise SarsplatError("there are no images to put on a contact sheet; give at least one")
    every = len(images)
    if every > _MOST:
        chosen = evenly(every, _MOST)
        images, views = images[chosen], [views[index] for index in chosen]
    columns = min(len(views), _MAX_COLUMNS, max(3, math.ceil(math.sqrt(len(views)))))
    lines = math.ceil(len(views) / columns)
    window = target_window(images, bright_level(images))
    shown, grid = _reduced(images[(slice(None), *window)], grid.part(*window))
    aspect = (grid.rows * grid.spacing_m[1]) / (grid.columns * grid.spacing_m[0])
    more = _LINE * max(view.unusual.count(", ") for view in views)  # below the angles, a line for each
    width, height = max(columns * _SIDE, 3.6), lines * (_SIDE * aspect + 0.22 + more) + 0.66
    margins = {"left": 0.02, "right": 0.98, "top": 1 - (0.24 + more) / height, "bottom": 0.6 / height}
    figure, panels = new_sheet((width, height), lines, columns, **margins, wspace=0.05, hspace=(0.2 + more) / _SIDE)
    for axes, image, view in zip(panels, shown, views):  # empty places stay dark
        title = f"{round(view.azimuth_deg, 1):g}°, grazing {round(view.grazing_deg, 1):g}°"
        title += view.unusual.replace(", ", "\n")
        draw_image(axes, image, grid, look, title, _TEXT)
    bar = ((1 - 2.6 / width) / 2, 0.44 / height, 2.6 / width, 0.08 / height)
    decibel_bar(figure, bar, look, "power, dB; 0 dB as in the single pictures")
    if every > len(images):
        figure.text(0.02, 0.2 / height, f"{len(images)} of {every} images", color=DARK.muted, size=9)
    return to_png(figure)


def _reduced(
    images: Real[np.ndarray, "v {grid.rows} {grid.columns}"], grid: ImageGrid
) -> tuple[Real[np.ndarray, "v rows columns"], ImageGrid]:
    """Average images until their shorter side has fewer than twice `_PIXELS` pixels."""
    factor = max(1, min(grid.rows, grid.columns) // _PIXELS)
    reduced = block_means(images, factor)
    rows, columns = reduced.shape[1:]
    cut = grid.part(slice(0, rows * factor), slice(0, columns * factor))
    azimuth, slant_range = cut.spacing_m
    return reduced, replace(cut, rows=rows, columns=columns, spacing_m=(azimuth * factor, slant_range * factor))


def sky_picture(
    train: Sequence[View], test: Sequence[View], title: str, kind: str = "png", zero: str = "nose"
) -> bytes:
    """Polar plot of views: zenith in the middle, at the rim the horizon, or the nadir if views are aloft.

    `zero` names azimuth 0. Shades the largest azimuth gap between training views (at least one), unless they are aloft.
    """
    figure = new_figure(5.6, 6.0)
    axes: Any = figure.add_axes((0.1, 0.12, 0.8, 0.72), projection="polar")  # PolarAxes
    axes.set_facecolor(DARK.card)
    axes.spines["polar"].set_color(DARK.line)
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    aloft = any(view.aloft for view in train)
    farthest, rings = (180, range(-60, 90, 30)) if aloft else (90, range(0, 90, 15))
    axes.set_rlim(0, farthest)
    axes.set_rgrids([90 - angle for angle in rings], [f"{angle}°" for angle in rings], angle=22.5)
    axes.tick_params(colors=DARK.muted, labelsize=9, length=3)
    axes.set_xticks([math.radians(angle) for angle in range(0, 360, 45)])
    axes.set_xticklabels([f"0° ({zero})", *(f"{angle}°" for angle in range(45, 360, 45))])
    axes.grid(color=DARK.line, linewidth=0.8)
    below = ""
    if not aloft:  # where no azimuth is a side of its own
        gap = largest_gap(view.azimuth_deg for view in train)
        start, width = math.radians(gap.first_deg), math.radians(gap.width_deg)
        axes.bar(start, farthest, width=width, align="edge", color=DARK.test, alpha=0.16, linewidth=0, zorder=0)
        below = f"\nlargest gap of the training views: {gap}"
    for views, marks in (
        (test, {"facecolors": "none", "edgecolors": DARK.test, "s": 26, "linewidths": 1.2, "label": "test"}),
        (train, {"color": DARK.train, "s": 30, "linewidths": 0, "label": "train"}),
    ):
        if views:
            angles = [math.radians(view.azimuth_deg) for view in views]
            axes.scatter(angles, [90 - view.grazing_deg for view in views], zorder=3, **marks)
    axes.set_title(f"{title}{below}", color=DARK.ink, size=10, pad=16)
    legend = figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    for text in legend.get_texts():
        text.set_color(DARK.ink)
    return to_png(figure, kind)


# ---- check sheet ----------------------------------------------------------------------------------------------------
_CHECK_WIDTH, _FOOT, _TITLE = 2.4, 1.3, 0.3  # inches
_TABLE_LINE, _TABLE_WIDTH = 0.17, 7.4  # inches
_CHECK_COLUMNS = 4
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
    columns = min(count, _CHECK_COLUMNS)
    lines = math.ceil(count / columns)
    aspect = grid.rows * grid.spacing_m[1] / (grid.columns * grid.spacing_m[0])
    above = _TITLE + _TABLE_LINE * max(dataset.views[index].unusual.count(", ") for index in chosen)
    tall = min(max(_CHECK_WIDTH * aspect, 0.8), 3 * _CHECK_WIDTH)
    table = (len(orientations) + 1) * _TABLE_LINE if orientations else 0.0
    foot = _FOOT + table
    width = max(columns * _CHECK_WIDTH, _TABLE_WIDTH if orientations else 2 * _CHECK_WIDTH)
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


def _table(figure: Figure, rows: Sequence[tuple[str, ...]]) -> None:
    """Write rows of text at the foot of the sheet; the best orientation is highlighted."""
    height = figure.get_size_inches()[1]
    for line, row in enumerate(reversed(rows)):
        colour = TARGET if "best" in row[-1] else DARK.ink if line == len(rows) - 1 else DARK.muted
        for place, text in zip(_PLACES, row, strict=True):
            figure.text(place, (0.1 + line * _TABLE_LINE) / height, text, color=colour, size=8, va="bottom")


def _contour(axes: Axes, mask: Bool[np.ndarray, "rows columns"], grid: ImageGrid, colour: str) -> None:
    if mask.any() and not mask.all() and min(mask.shape) > 1:
        axes.contour(grid.azimuth_m, grid.range_m, mask.astype(float), levels=[0.5], colors=[colour], linewidths=1.1)


def _nose(axes: Axes, view: View, grid: ImageGrid) -> None:
    """Draw the direction of the nose from the middle of an image."""
    left, right, bottom, top = grid.extent_m
    nose: Float64[np.ndarray, " 2"] = view.look.gradients[:, 0] * _NOSE * min(right - left, bottom - top)
    middle = grid.center_m
    end = (middle[0] + float(nose[0]), middle[1] + float(nose[1]))
    arrow(axes, middle, end, ":")


# ---- shared ----------------------------------------------------------------------------------------------------------
def new_figure(width: float, height: float) -> Figure:
    """Empty dark figure, inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor=DARK.card)
    FigureCanvasAgg(figure)
    return figure


def new_sheet(size: tuple[float, float], lines: int, columns: int, **margins: float) -> tuple[Figure, list[Axes]]:
    """Dark figure of width × height, inches, and empty axes for images, row by row."""
    figure = new_figure(*size)
    places = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
    figure.subplots_adjust(**margins)
    for axes in places:
        axes.set_axis_off()
    return figure, places


def draw_image(axes: Axes, power: np.ndarray, grid: ImageGrid, look: Look, title: str, size: float) -> None:
    """Draw β⁰ [rows, columns] in decibels, axes in metres, with radar, scale and title; text of `size` points."""
    from matplotlib.text import OffsetFrom

    levels: dict[str, Any] = {"cmap": colormap(look.cmap), "vmin": -look.range_db, "vmax": 0}
    axes.imshow(to_db(power, look.peak), extent=grid.extent_m, interpolation="nearest", **levels)
    words: dict[str, Any] = {"color": DARK.ink, "size": size, "bbox": _PLATE}
    radar = axes.text(_EDGE, 1 - _EDGE, "radar", transform=axes.transAxes, va="top", **words)
    below = OffsetFrom(radar, (0.5, 0.0))  # in points: as long on images of any size
    arrow(axes, (0, -0.5 * size), (0, -2.8 * size), xycoords=below, textcoords=below)
    share, length = scale_bar(grid.columns * grid.spacing_m[0])
    right = 1 - _EDGE
    for colour, width in ((DARK.card, 4.0), (DARK.ink, 1.8)):  # dark around light
        ends = [right - share, right], [_EDGE] * 2
        axes.plot(*ends, transform=axes.transAxes, color=colour, linewidth=width, solid_capstyle="butt")
    words |= {"xycoords": "axes fraction", "textcoords": "offset points", "ha": "center", "va": "bottom"}
    axes.annotate(length, (right - share / 2, _EDGE), (0, 4), **words)
    axes.set_title(title, color=DARK.ink, size=size, pad=3)


def arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], line: str = "-", **coordinates: Any
) -> None:
    """Draw a light arrow with a dark edge, visible on any image."""
    from matplotlib.patheffects import withStroke

    style = {"arrowstyle": "->", "color": DARK.ink, "linestyle": line, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0}
    edge = [withStroke(linewidth=3.0, foreground=DARK.card)]
    axes.annotate("", end, start, arrowprops=style | {"path_effects": edge}, **coordinates)


def decibel_bar(figure: Figure, place: tuple[float, float, float, float], look: Look, label: str) -> None:
    """Draw a horizontal colour bar; the label explains 0 dB."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes(place)
    colours = ScalarMappable(Normalize(-look.range_db, 0), colormap(look.cmap))
    bar: Any = figure.colorbar(colours, cax=axes, orientation="horizontal")
    bar.set_label(label, color=DARK.muted, size=9)
    bar.outline.set_visible(False)
    axes.tick_params(colors=DARK.muted, labelsize=8, length=3)


def to_png(figure: Figure, kind: str = "png") -> bytes:
    """Encode a figure as PNG or another `kind` of file."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None  # the same figure, the same file
    figure.savefig(buffer, format=kind, dpi=110, facecolor=DARK.card, metadata=metadata)
    return buffer.getvalue()
