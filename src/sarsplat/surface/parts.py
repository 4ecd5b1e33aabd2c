"""A cloud of points in parts, each with what is near it: for work whose memory would grow with the cloud."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int64, Real

MOST_POINTS = 1 << 20
"""Of a part, unless more lie in one place."""


def parts_of(
    points: Real[np.ndarray, "p 3"], reach_m: float, most: int = MOST_POINTS
) -> Iterator[tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]]:
    """Indices of some points, in their order, and which of them make a part; the others are at most so far from it.

    Each point is in one part. A cloud of at most so many points is one.
    """
    everything = np.arange(len(points))
    yield from _halved(points, everything, np.ones(len(points), bool), reach_m, most)


def _halved(
    points: Real[np.ndarray, "p 3"],
    some: Int64[np.ndarray, " k"],
    own: Bool[np.ndarray, " k"],
    reach_m: float,
    most: int,
) -> Iterator[tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]]:
    mine = points[some[own]]
    sides = np.ptp(mine, axis=0) if len(mine) else np.zeros(3)
    axis = int(sides.argmax())
    if len(mine) <= most or sides[axis] <= 2 * reach_m:
        yield some, own
        return
    middle, place, lowest = np.median(mine[:, axis]), points[some, axis], mine[:, axis].min()
    if middle == lowest:  # most of them: what is beyond is the other half
        middle = mine[mine[:, axis] > lowest, axis].min()
    middle = float(middle)
    del mine
    for side, near in ((place < middle, place < middle + reach_m), (place >= middle, place >= middle - reach_m)):
        yield from _halved(points, some[near], (own & side)[near], reach_m, most)
