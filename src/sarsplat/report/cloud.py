"""The reconstructed points from three sides, beside the true surface where it is known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sarsplat.colours import ERROR, HEIGHT
from sarsplat.errors import counted
from sarsplat.report.figure import Block, ColourBar, colour_bar
from sarsplat.report.sides import Corner, Raster

Points = Float[np.ndarray, "p 3"]

_LEAST_PIXELS, _MOST_PIXELS = 120, 400  # along the longest side of what is shown
_MARGIN = 0.025
"""Around the points, as a part of the longest side."""


def point_boards(
    clouds: Mapping[str, Points], surface: Float[np.ndarray, "s 3"] | None, farthest_m: float
) -> tuple[tuple[Block, ...], tuple[ColourBar, ...]]:
    """Points from the side, the front and the top, coloured by height; then their distances to the true surface.

    Parameters
    ----------
    clouds : mapping of str to numpy.ndarray, float [P, 3]
        Reconstructed points, m, by name.
    surface : numpy.ndarray, float [S, 3] or None
        Samples of the true surface, m; drawn before the points.
    farthest_m : float
        Distances to the surface beyond this share one colour, m.
    """
    by_height = {f"{name}, {counted(len(points), 'point')}": points for name, points in clouds.items()}
    if surface is not None:
        by_height = {"true surface": surface, **by_height}
    low, high = _limits(np.concatenate(list(by_height.values())))
    fewest = min((len(points) for points in by_height.values() if len(points)), default=0)
    raster = Raster.around(low, high, int(np.clip(2 * np.sqrt(fewest), _LEAST_PIXELS, _MOST_PIXELS)))
    blocks = [
        raster.board(name, points, points[:, 2], (float(low[2]), float(high[2])), HEIGHT)
        for name, points in by_height.items()
    ]
    bars = [colour_bar("height z, m", HEIGHT, float(low[2]), float(high[2]))]
    if surface is not None:
        tree = KDTree(surface)
        for name, points in clouds.items():
            distance = tree.query(points)[0] if len(points) else np.empty(0)
            blocks.append(raster.board(f"error of the {name}", points, distance, (0.0, farthest_m), ERROR))
        bars.append(colour_bar("distance to the true surface, m", ERROR, 0, farthest_m))
    return tuple(blocks), tuple(bars)


def _limits(points: Points) -> tuple[Corner, Corner]:
    """Corners of the space shown, m; a few strays do not shrink everything else."""
    if len(points) == 0:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    margin = _MARGIN * float((high - low).max()) or 1.0  # of a single point
    return low - margin, high + margin
