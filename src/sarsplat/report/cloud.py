"""The reconstructed points from three sides, beside the true surface where it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sarsplat.report.canvas import INK, MUTED, colour_bar, dress, new_figure, ramp, to_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import SubFigure

# Name, horizontal and vertical axis, axis that points at the viewer, its sign.
_SIDES = (("side", 0, 2, 1, -1), ("front", 1, 2, 0, 1), ("top", 0, 1, 2, 1))
_MARGIN = 0.025
"""Around the points, as a part of the longest side."""


def points_figure(
    points: Float[np.ndarray, "p 3"], surface: Float[np.ndarray, "s 3"] | None, farthest_m: float
) -> bytes:
    """Points from the side, the front and the top, on equal axes in metres, as PNG.

    Parameters
    ----------
    points : numpy.ndarray, float [P, 3]
        Reconstructed points, m; coloured by distance to `surface`, or by height without one.
    surface : numpy.ndarray, float [S, 3] or None
        Samples of the true surface, m; drawn beside the points.
    farthest_m : float
        Distances to the surface from here on look alike, m.
    """
    shown = points if surface is None else np.concatenate([points, surface])
    low, high = _limits(shown)
    heights = ramp("height", "#1d3a6b", "#2f86b8", "#7fd6c2", "#f4f1c6")
    blocks: list[tuple[str, np.ndarray, np.ndarray, tuple[float, float], str, str]] = []
    top = max(float(shown[:, 2].max(initial=0)), _MARGIN * float((high - low).max()))
    if surface is None:
        blocks.append((f"{len(points):,} points", points, points[:, 2], (0, top), "height", "height, m"))
        colours = {"height": heights}
    else:
        distance = KDTree(surface).query(points)[0]
        blocks.append(("true surface", surface, surface[:, 2], (0, top), "height", "height, m"))
        name = f"reconstruction, {len(points):,} points"
        label = "distance to truth, m"
        blocks.append((name, points, distance, (0, farthest_m), "distance", label))
        colours = {"height": heights, "distance": ramp("distance", "#37c9a4", "#d9d37a", "#ff9248", "#f0386b")}
    size = high - low
    scale = 5.4 / (size[0] + size[1])  # inches per metre
    height = (size[2] + size[1]) * scale + 1.2
    figure = new_figure(len(blocks) * 6.4, height)
    for block, (name, cloud, value, limits, kind, label) in zip(
        figure.subfigures(1, len(blocks), squeeze=False)[0], blocks, strict=True
    ):
        block.set_facecolor("none")
        bar = _draw(block, cloud, np.clip(value, *limits), colours[kind], (low, high), height)
        colour_bar(figure, bar, colours[kind], limits, label)
        block.text(0.09, 1 - 0.24 / height, name, color=INK, size=11, weight="bold")
    return to_png(figure)


def _limits(points: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Corners of the space shown, m; a few strays do not shrink everything else."""
    if len(points) == 0:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    margin = _MARGIN * float((high - low).max()) or 1.0  # of a single point
    return low - margin, high + margin


def _draw(
    block: SubFigure,
    points: Float[np.ndarray, "p 3"],
    value: Float[np.ndarray, " p"],
    colours: Colormap,
    limits: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]],
    height: float,
) -> Axes:
    """Three sides as on a drawing board; returns axes for the colour bar."""
    low, high = limits
    size = high - low
    grid = block.add_gridspec(
        2,
        2,
        width_ratios=(size[0], size[1]),
        height_ratios=(size[2], size[1]),
        left=0.09,
        right=0.985,
        top=1 - 0.5 / height,
        bottom=0.34 / height,
        wspace=0.12,
        hspace=0.24,
    )
    for (name, across, up, towards, sign), place in zip(_SIDES, (grid[0, 0], grid[0, 1], grid[1, 0]), strict=True):
        axes = block.add_subplot(place)
        order = np.argsort(sign * points[:, towards])  # the nearest last, on top
        axes.scatter(
            points[order, across], points[order, up], c=value[order], cmap=colours, s=1.2, linewidths=0, rasterized=True
        )
        axes.set_xlim(low[across], high[across])
        axes.set_ylim(low[up], high[up])
        axes.set_aspect("equal")
        dress(axes)
        axes.set_title(f"{name}, m", loc="left", size=9, color=MUTED, pad=3)
    corner = block.add_subplot(grid[1, 1])
    corner.set_axis_off()
    return corner.inset_axes((0.08, 0.5, 0.84, 0.05))
