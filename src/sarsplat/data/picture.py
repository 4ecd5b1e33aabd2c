"""A SAR image as a picture: decibels in grey, axes in metres, near range on top."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Real

from sarsplat.colours import POWER, colormap
from sarsplat.errors import SarsplatError
from sarsplat.radiometry import to_db

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sarsplat.geometry import ImageGrid, View

_INCHES = 5.0  # the image's longer side
_DPI = 120

Power = Real[np.ndarray, "rows columns"]


def picture_png(power: Power, view: View, grid: ImageGrid, dynamic_range_db: float) -> bytes:
    """β⁰ of one image as a PNG file; parameters and errors as for `SarImage` and its `save`."""
    with _matplotlib_needed():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure, buffer = Figure(), io.BytesIO()
    FigureCanvasAgg(figure)
    _draw(power, view, grid, figure, dynamic_range_db)
    figure.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()


def open_window(power: Power, view: View, grid: ImageGrid, dynamic_range_db: float) -> None:
    """Show the image with pyplot: a window, or a picture in a notebook."""
    with _matplotlib_needed():
        from matplotlib import pyplot
    _draw(power, view, grid, pyplot.figure(), dynamic_range_db)
    pyplot.show()


@contextmanager
def _matplotlib_needed() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise SarsplatError("pictures need matplotlib; install it with: pip install 'sarsplat[report]'") from error


def _draw(power: Power, view: View, grid: ImageGrid, figure: Figure, dynamic_range_db: float) -> None:
    """White is the brightest pixel, black is `dynamic_range_db` below it and everything darker."""
    if not 0 < dynamic_range_db < np.inf:
        raise SarsplatError(
            f"a dynamic range of {dynamic_range_db} dB cannot be drawn; give a positive one, such as 40"
        )
    extent = grid.extent_m
    width, height = extent[1] - extent[0], extent[2] - extent[3]
    scale = _INCHES / max(width, height)
    figure.set_size_inches(max(width * scale, 1.5) + 1.9, max(height * scale, 1.5) + 1.0)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    brightest = float(power.max(initial=0))
    top = to_db(brightest or 1.0)
    shades = axes.imshow(
        np.maximum(to_db(power, least=0.0), top - dynamic_range_db),
        cmap=colormap(POWER),
        vmin=top - dynamic_range_db,
        vmax=top,
        extent=extent,
        interpolation="nearest",
    )
    axes.set_title(f"azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}°")
    axes.set_xlabel("azimuth, m")
    axes.set_ylabel("slant range, m")
    figure.colorbar(shades, ax=axes, label="β⁰, dB", shrink=0.9)
