"""Views as points on the sky, as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from sarsplat.colours import DARK
from sarsplat.data.coverage import largest_gap
from sarsplat.geometry import View
from sarsplat.report.sheet import new_figure, to_png

_SIZE = (5.6, 6.0)  # inches


def sky_picture(
    train: Sequence[View], test: Sequence[View], title: str, kind: str = "png", zero: str = "nose"
) -> bytes:
    """Polar plot of views: zenith in the middle, at the rim the horizon, or the nadir if views are aloft.

    `zero` names azimuth 0. Shades the largest azimuth gap between training views (at least one), unless they are aloft.
    """
    figure = new_figure(*_SIZE)
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
