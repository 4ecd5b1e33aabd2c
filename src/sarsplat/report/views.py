"""Unseen views: truth, rendering and their difference in decibels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Real
from scipy.ndimage import uniform_filter

from sarsplat.geometry import ImageGrid, View
from sarsplat.report.canvas import INK, MUTED, colour_bar, dress, new_figure, ramp, to_png
from sarsplat.report.decibels import DYNAMIC_DB, to_decibels
from sarsplat.report.window import target_window

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

_MAX_DB = {False: 6.0, True: 10.0}  # larger differences look alike; by whether there is speckle
_BESIDE = 2  # views side by side

# Inches: one panel; a block of three with its axis labels; title of a view; heading; foot with the colour bars.
_SIDE, _BLOCK, _TITLE, _HEAD, _FOOT = 1.85, 6.4, 0.3, 0.3, 1.15


def evenly(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` indices, evenly spread, both ends among them."""
    return sorted({int(index) for index in np.linspace(0, count - 1, min(count, wanted)).round()})


def view_name(view: View) -> str:
    """E.g. azimuth 30°, grazing 17.4°."""
    return f"azimuth {round(view.azimuth_deg, 1):g}°, grazing {round(view.grazing_deg, 1):g}°"


def views_figure(
    truth: Real[np.ndarray, "v rows columns"],
    rendered: Real[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    peak: float,
    *,
    speckled: bool,
    margin: int,
) -> bytes:
    """Truth | rendered | difference of every view, as PNG.

    Parameters
    ----------
    truth, rendered : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    views, grid
        From where, and where the pixels lie.
    peak : float
        The power shown white: the largest of the training set.
    speckled : bool
        Whether the truth is speckled: the difference is then that of 3×3 means.
    margin : int
        Pixels on each side that are not scored.
    """
    max_db = _MAX_DB[speckled]
    rows, columns = target_window(np.maximum(truth, rendered), peak, margin)
    extent = (
        grid.azimuth_m[columns][0] - grid.spacing_m[0] / 2,
        grid.azimuth_m[columns][-1] + grid.spacing_m[0] / 2,
        grid.range_m[rows][-1] + grid.spacing_m[1] / 2,
        grid.range_m[rows][0] - grid.spacing_m[1] / 2,
    )
    beside = min(_BESIDE, len(views))
    lines = -(-len(views) // beside)
    picture_height = _SIDE * (extent[2] - extent[3]) / (extent[1] - extent[0])
    height = lines * (picture_height + _TITLE) + _HEAD + _FOOT
    figure = new_figure(beside * _BLOCK, height)
    blocks = figure.subfigures(1, beside, squeeze=False)[0]
    for number, block in enumerate(blocks):
        block.set_facecolor("none")
        panels = block.subplots(lines, 3, squeeze=False, sharex=True, sharey=True)
        block.subplots_adjust(
            left=0.6 / _BLOCK,
            right=1 - 0.08 / _BLOCK,
            top=1 - (_HEAD + _TITLE) / height,
            bottom=_FOOT / height,
            wspace=0.05,
            hspace=_TITLE / picture_height,
        )
        for axes, name in zip(panels[0], ("truth", "rendered", "difference"), strict=True):
            axes.annotate(
                name, (0.5, 1), (0, 23), "axes fraction", "offset points", ha="center", color=INK, weight="bold"
            )
        for axes in panels.flat:
            axes.set_axis_off()
        for line, index in enumerate(range(number, len(views), beside)):
            difference = _difference_db(truth[index], rendered[index], peak, speckled)
            pictures = (to_decibels(truth[index], peak), to_decibels(rendered[index], peak), difference)
            styles = (("gray", -DYNAMIC_DB, 0), ("gray", -DYNAMIC_DB, 0), (_differences(), -max_db, max_db))
            for axes, picture, (colours, low, high) in zip(panels[line], pictures, styles, strict=True):
                axes.set_axis_on()
                dress(axes)
                axes.imshow(
                    picture[rows, columns], cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="nearest"
                )
            panels[line, 1].set_title(view_name(views[index]), size=9)
    blocks[0].supylabel("slant range, m", color=MUTED, size=9, x=0.1 / _BLOCK)
    figure.text(0.5, (_FOOT - 0.4) / height, "azimuth, m", ha="center", color=MUTED, size=9)
    means = " (3×3 means)" if speckled else ""
    bars = (
        (0.12, ramp("grey", "black", "white"), (-DYNAMIC_DB, 0.0), "power, dB of the brightest training pixel"),
        (0.62, _differences(), (-max_db, max_db), f"rendered over truth, dB{means}"),
    )
    for x, colours, limits, label in bars:
        colour_bar(figure, figure.add_axes((x, 0.42 / height, 0.26, 0.09 / height)), colours, limits, label)
    return to_png(figure)


def _differences() -> Colormap:
    """Blue where the rendering is too dark, orange where it is too bright."""
    return ramp("difference", "#7fd4ff", "#2b7fd0", "#151a21", "#d0602b", "#ffc37f")


def _difference_db(
    truth: Real[np.ndarray, "rows columns"], rendered: Real[np.ndarray, "rows columns"], peak: float, speckled: bool
) -> Float[np.ndarray, "rows columns"]:
    """Rendered over truth, dB; what is darker than the pictures show counts as equally dark."""
    floor = peak * 10 ** (-DYNAMIC_DB / 10)
    if speckled:
        truth, rendered = (uniform_filter(power, 3) for power in (truth, rendered))
    return to_decibels(np.maximum(rendered, floor)) - to_decibels(np.maximum(truth, floor))
