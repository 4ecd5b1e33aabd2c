"""Marks on every SAR image of a sheet: the direction of the radar and a scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sarsplat.colours import DARK
from sarsplat.report.figure import scale_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PLATE: dict[str, Any] = {"facecolor": DARK.card, "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
"""Behind words on an image, however bright that is."""

_EDGE = 0.05  # of a panel, free around marks


def mark_radar(axes: Axes, size: float) -> None:
    """An arrow along the line of sight, at the upper left: the radar is above, near range first."""
    from matplotlib.text import OffsetFrom

    word = axes.text(
        _EDGE, 1 - _EDGE, "radar", transform=axes.transAxes, color=DARK.ink, size=size, va="top", bbox=_PLATE
    )
    below = OffsetFrom(word, (0.5, 0.0))  # in points: as long on panels of any size
    arrow(axes, (0, -0.5 * size), (0, -2.8 * size), xycoords=below, textcoords=below)


def mark_scale(axes: Axes, width_m: float, size: float) -> None:
    """A scale bar at the lower right of a panel that is `width_m` wide."""
    share, text = scale_bar(width_m)
    right = 1 - _EDGE
    ends = [right - share, right]
    for colour, width in ((DARK.card, 4.0), (DARK.ink, 1.8)):  # dark around light
        axes.plot(ends, [_EDGE] * 2, transform=axes.transAxes, color=colour, linewidth=width, solid_capstyle="butt")
    axes.annotate(
        text,
        (right - share / 2, _EDGE),
        (0, 4),
        xycoords="axes fraction",
        textcoords="offset points",
        color=DARK.ink,
        size=size,
        ha="center",
        va="bottom",
        bbox=_PLATE,
    )


def arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], line: str = "-", **coordinates: Any
) -> None:
    """A light arrow with a dark edge, to be seen on any image."""
    from matplotlib.patheffects import withStroke

    style = {"arrowstyle": "->", "color": DARK.ink, "linestyle": line, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0}
    edge = [withStroke(linewidth=3.0, foreground=DARK.card)]
    axes.annotate("", end, start, arrowprops=style | {"path_effects": edge}, **coordinates)
