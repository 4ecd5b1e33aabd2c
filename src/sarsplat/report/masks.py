"""Unseen chips with the outlines of target and shadow, true and predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.geometry import ImageGrid, View
from sarsplat.report.canvas import BLUE, INK, ORANGE, dress, new_figure, to_png
from sarsplat.report.decibels import DYNAMIC_DB, to_decibels
from sarsplat.report.views import view_name

_SIDE, _BESIDE, _TITLE, _FOOT = 2.6, 3, 0.3, 0.35  # inches; panels side by side
_MARGIN = 5  # pixels around everything that a mask shows
_LINES = {1: "solid", 2: "dotted"}


def masks_figure(
    images: Real[np.ndarray, "v rows columns"],
    truth: UInt8[np.ndarray, "v rows columns"],
    predicted: UInt8[np.ndarray, "v rows columns"],
    views: Sequence[View],
    grid: ImageGrid,
    peak: float,
) -> bytes:
    """Images with the outlines of both masks, as PNG.

    Parameters
    ----------
    images : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    truth, predicted : numpy.ndarray, uint8 [V, rows, columns]
        0 clutter, 1 target, 2 shadow.
    views, grid
        From where, and where the pixels lie.
    peak : float
        The power shown white.
    """
    anything = np.maximum(truth, predicted).max(axis=0)
    rows, columns = (_window(np.max(anything, axis=1 - axis)) for axis in (0, 1))
    aspect = grid.spacing_m[1] / grid.spacing_m[0]
    beside = min(_BESIDE, len(views))
    lines = -(-len(views) // beside)
    panel = _SIDE * aspect * (rows.stop - rows.start) / (columns.stop - columns.start)
    width, height = max(beside * _SIDE, 2 * _SIDE), lines * (panel + _TITLE) + _FOOT
    figure = new_figure(width, height)
    panels = figure.subplots(lines, beside, squeeze=False)
    figure.subplots_adjust(
        left=0.02, right=0.98, top=1 - _TITLE / height, bottom=_FOOT / height, wspace=0.04, hspace=_TITLE / panel
    )
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, image, true, own, view in zip(panels.flat, images, truth, predicted, views):
        dress(axes)
        shown = to_decibels(image, peak)[rows, columns]
        axes.imshow(shown, cmap="gray", vmin=-DYNAMIC_DB, vmax=0, aspect=aspect, interpolation="nearest")
        for mask, colour in ((true, BLUE), (own, ORANGE)):
            for kind, line in _LINES.items():
                pixels = np.asarray(mask == kind)[rows, columns]
                if pixels.any() and not pixels.all():
                    axes.contour(pixels, [0.5], colors=colour, linestyles=line, linewidths=1.2)
        axes.set_title(view_name(view), size=9)
    text = {"true": BLUE, "predicted": ORANGE, "solid: target, dotted: shadow": INK}
    for place, (words, colour) in zip((0.06, 0.2, 0.42), text.items(), strict=True):
        figure.text(place, 0.1 / height, words, color=colour, size=9)
    return to_png(figure)


def _window(there: Real[np.ndarray, " n"]) -> slice:
    """From the first to the last that is there, with a margin; all if nothing is."""
    found = np.flatnonzero(there)
    if len(found) == 0:
        return slice(0, len(there))
    return slice(max(int(found[0]) - _MARGIN, 0), min(int(found[-1]) + 1 + _MARGIN, len(there)))
