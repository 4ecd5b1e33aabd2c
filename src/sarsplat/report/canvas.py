"""The look that all figures share: dark panels, which sit well on light and on dark pages."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

PANEL, INK, MUTED, FAINT = "#10151c", "#e3e9f1", "#93a1b3", "#2a3441"
BLUE, ORANGE = "#5cc8ff", "#ffb454"


def new_figure(width: float, height: float) -> Figure:
    """An empty panel, inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor=PANEL)
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes) -> None:
    """Colours of one set of axes."""
    axes.set_facecolor(PANEL)
    axes.tick_params(which="both", colors=MUTED, labelsize=8, length=3)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    axes.xaxis.label.set(color=MUTED, size=9)
    axes.yaxis.label.set(color=MUTED, size=9)
    axes.title.set(color=INK, size=10)


def colour_bar(figure: Figure, where: Axes, colours: Colormap, limits: tuple[float, float], label: str) -> None:
    """A horizontal colour bar that fills the axes `where`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    bar = figure.colorbar(ScalarMappable(Normalize(*limits), colours), cax=where, orientation="horizontal")
    bar.set_label(label, color=MUTED, size=9)
    bar.outline.set_visible(False)
    where.tick_params(colors=MUTED, labelsize=8, length=3)


def ramp(name: str, *colours: str) -> Colormap:
    """A colour map through these colours."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(name, list(colours))


def to_png(figure: Figure, dpi: int = 110) -> bytes:
    """The finished figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor=figure.get_facecolor())
    return buffer.getvalue()
