"""Many images on one sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Real

from sarsplat.arguments import checks_arguments
from sarsplat.colours import DARK
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import bright_level
from sarsplat.report.canvas import decibel_bar, draw_image, new_sheet, to_png
from sarsplat.report.look import Look
from sarsplat.report.raster import block_means
from sarsplat.report.window import target_window

_SIDE = 1.6  # inches
_MAX_COLUMNS = 8
_MOST = 12 * _MAX_COLUMNS  # images: more would not fit on a screen
_TEXT = 7.5  # points
_PIXELS = 512  # of an image's shorter side: a place has fewer


@checks_arguments
def contact_sheet(
    images: Real[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid, look: Look
) -> bytes:
    """All images in decibels, the same part of each with the target in it, with view, scale and radar, as PNG.

    Parameters
    ----------
    images : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    views, grid
        From where, and where the pixels lie.
    look : Look
        The colours, as of the single pictures.

    Raises
    ------
    SarsplatError
        If there are no images.

    Notes
    -----
    Of more than 96 images, 96 are shown that are evenly spaced in their order; the sheet says so.
    """
    if len(images) == 0:
        raise SarsplatError("there are no images to put on a contact sheet; give at least one")
    every = len(images)
    chosen = np.unique(np.linspace(0, every - 1, min(every, _MOST)).round().astype(int))
    if len(chosen) < every:
        images, views = images[chosen], [views[index] for index in chosen]
    columns = min(len(views), _MAX_COLUMNS, max(3, math.ceil(math.sqrt(len(views)))))
    lines = math.ceil(len(views) / columns)
    window = target_window(images, bright_level(images))
    shown, grid = _reduced(images[(slice(None), *window)], grid.part(*window))
    aspect = (grid.rows * grid.spacing_m[1]) / (grid.columns * grid.spacing_m[0])
    width, height = max(columns * _SIDE, 3.6), lines * (_SIDE * aspect + 0.22) + 0.66
    margins = {"left": 0.02, "right": 0.98, "top": 1 - 0.24 / height, "bottom": 0.6 / height}
    figure, panels = new_sheet((width, height), lines, columns, **margins, wspace=0.05, hspace=0.2 / _SIDE)
    for axes, image, view in zip(panels, shown, views):  # empty places stay dark
        title = f"{round(view.azimuth_deg, 1):g}°, grazing {round(view.grazing_deg, 1):g}°"
        draw_image(axes, image, grid, look, title, _TEXT)
    bar = ((1 - 2.6 / width) / 2, 0.44 / height, 2.6 / width, 0.08 / height)
    decibel_bar(figure, bar, look, "power, dB; 0 dB as in the single pictures")
    if every > len(images):
        figure.text(0.02, 0.2 / height, f"{len(images)} of {every} images", color=DARK.muted, size=9)
    return to_png(figure)


def _reduced(
    images: Real[np.ndarray, "v {grid.rows} {grid.columns}"], grid: ImageGrid
) -> tuple[Real[np.ndarray, "v rows columns"], ImageGrid]:
    """Means over so many pixels that a place on the sheet can show them."""
    factor = max(1, min(grid.rows, grid.columns) // _PIXELS)
    reduced = block_means(images, factor)
    rows, columns = reduced.shape[1:]
    cut = grid.part(slice(0, rows * factor), slice(0, columns * factor))
    azimuth, slant_range = cut.spacing_m
    return reduced, replace(cut, rows=rows, columns=columns, spacing_m=(azimuth * factor, slant_range * factor))
