"""The reconstructed points from three sides, beside the true surface where it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sarsplat.report.canvas import colour_bar, ramp, to_png
from sarsplat.report.sides import SIDES, Board, drawing_boards

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

_DRAWN = 30_000
"""Most points drawn of a cloud."""

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
        blocks.append((_title(points), points, points[:, 2], (0, top), "height", "height, m"))
        colours = {"height": heights}
    else:
        distance = KDTree(surface).query(points)[0]
        blocks.append(("true surface", surface, surface[:, 2], (0, top), "height", "height, m"))
        label = "distance to truth, m"
        blocks.append((f"reconstruction, {_title(points)}", points, distance, (0, farthest_m), "distance", label))
        colours = {"height": heights, "distance": ramp("distance", "#37c9a4", "#d9d37a", "#ff9248", "#f0386b")}
    figure, boards = drawing_boards([name for name, *_ in blocks], low, high)
    chance = np.random.default_rng(0)
    for board, (_, cloud, value, limits, kind, label) in zip(boards, blocks, strict=True):
        some = chance.permutation(len(cloud))[:_DRAWN]  # a denser cloud would only look more solid
        _draw(board, cloud[some], np.clip(value[some], *limits), colours[kind])
        colour_bar(figure, board.corner.inset_axes((0.08, 0.5, 0.84, 0.05)), colours[kind], limits, label)
    return to_png(figure)


def _title(points: Float[np.ndarray, "p 3"]) -> str:
    return f"{len(points):,} points" + (f", {_DRAWN:,} drawn" if len(points) > _DRAWN else "")


def _limits(points: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Corners of the space shown, m; a few strays do not shrink everything else."""
    if len(points) == 0:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    margin = _MARGIN * float((high - low).max()) or 1.0  # of a single point
    return low - margin, high + margin


def _draw(board: Board, points: Float[np.ndarray, "p 3"], value: Float[np.ndarray, " p"], colours: Colormap) -> None:
    """The points on each side, the nearest on top."""
    for axes, side in zip(board.sides, SIDES, strict=True):
        order = np.argsort(side.sign * points[:, side.towards])
        x, y = points[order, side.across], points[order, side.up]
        axes.scatter(x, y, c=value[order], cmap=colours, s=1.2, linewidths=0, rasterized=True)
