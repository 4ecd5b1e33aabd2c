"""Shared style of matplotlib figures: dark panels that suit light and dark pages."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from sarsplat.colours import DARK, colormap
from sarsplat.radiometry import OF_THE_BRIGHTEST, to_db
from sarsplat.report.marks import mark_radar, mark_scale

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sarsplat.geometry import ImageGrid
    from sarsplat.report.look import Look


def new_figure(width: float, height: float) -> Figure:
    """An empty panel, inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor=DARK.card)
    FigureCanvasAgg(figure)
    return figure


def new_sheet(size: tuple[float, float], lines: int, columns: int, **margins: float) -> tuple[Figure, list[Axes]]:
    """A panel of width × height, inches, with empty places for images, row by row."""
    figure = new_figure(*size)
    places = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
    figure.subplots_adjust(**margins)
    for axes in places:
        axes.set_axis_off()
    return figure, places


def dress(axes: Axes) -> None:
    """Apply the style to one set of axes."""
    axes.set_facecolor(DARK.card)
    axes.tick_params(which="both", colors=DARK.muted, labelsize=8, length=3)
    for spine in axes.spines.values():
        spine.set_color(DARK.line)
    axes.xaxis.label.set(color=DARK.muted, size=9)
    axes.yaxis.label.set(color=DARK.muted, size=9)
    axes.title.set(color=DARK.ink, size=10)


def draw_image(axes: Axes, power: np.ndarray, grid: ImageGrid, look: Look, title: str, size: float) -> None:
    """β⁰ [rows, columns] in decibels, axes in metres, with radar, scale and title; text of `size` points."""
    axes.imshow(
        to_db(power, look.peak),
        cmap=colormap(look.cmap),
        vmin=-look.range_db,
        vmax=0,
        extent=grid.extent_m,
        interpolation="nearest",
    )
    dress(axes)
    mark_radar(axes, size)
    mark_scale(axes, grid.columns * grid.spacing_m[0], size)
    axes.set_title(title, size=size, pad=3)


def decibel_bar(
    figure: Figure, place: tuple[float, float, float, float], look: Look, label: str = OF_THE_BRIGHTEST
) -> None:
    """A horizontal colour bar at a place of a sheet; the label says what 0 dB is."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes(place)
    colours = ScalarMappable(Normalize(-look.range_db, 0), colormap(look.cmap))
    bar: Any = figure.colorbar(colours, cax=axes, orientation="horizontal")
    bar.set_label(label, color=DARK.muted, size=9)
    bar.outline.set_visible(False)
    axes.tick_params(colors=DARK.muted, labelsize=8, length=3)


def to_png(figure: Figure, dpi: int = 110) -> bytes:
    """The finished figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor=figure.get_facecolor())
    return buffer.getvalue()
