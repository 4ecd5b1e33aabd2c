"""Orthographic views of points from three sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from sarsplat.colours import hollow
from sarsplat.report.figure import Block, Panel, axis, scale_bar
from sarsplat.report.images import address, indexed

Corner = Float[np.ndarray, " 3"]
Seen = Int64[np.ndarray, "rows columns"]
"""Index of the point that is seen in each pixel, row 0 at the top; −1 where there is none."""

_AT_ONCE = 1 << 14  # points: what is calculated of them stays in the processor's cache


@dataclass(frozen=True)
class Side:
    """From where a target is seen: axes of the world, 0 to 2; `sign` is −1 if `towards` points away from the viewer."""

    name: str
    across: int
    up: int
    towards: int
    sign: int


_WIDEST = 15  # pixels of a point

SIDES = (Side("side", 0, 2, 1, -1), Side("front", 1, 2, 0, 1), Side("top", 0, 1, 2, 1))


@dataclass(frozen=True)
class Raster:
    """The space between the corners `low` and `high`, m, in square pixels."""

    low: Corner
    high: Corner
    pixel_m: float

    @classmethod
    def around(cls, low: Corner, high: Corner, pixels: int) -> Raster:
        """A raster with so many pixels along the longest side."""
        return cls(low, high, float((high - low).max()) / pixels)

    def nearest(
        self, points: Float[np.ndarray, "p 3"], side: Side, size: int = 1
    ) -> tuple[Int64[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
        """Index of the point that is seen in each pixel from a side, row 0 at the top, and whether there is one.

        A point covers `size` × `size` pixels.
        """
        sight = Sight(self, side, size)
        for first in range(0, len(points), _AT_ONCE):
            sight.add(first, points[first : first + _AT_ONCE].T)
        return sight.seen, sight.seen >= 0

    def sides(self, points: Float[np.ndarray, "p 3"], width_m: float) -> list[Seen]:
        """What is seen from the three sides of points that are so wide, m."""
        size = int(np.clip(np.ceil(width_m / self.pixel_m), 1, _WIDEST))
        return [self.nearest(points, side, size)[0] for side in SIDES]

    def board(
        self, title: str, seen: Sequence[Seen], values: Float[np.ndarray, " p"],
        limits: tuple[float, float], colours: str,
    ) -> Block:  # fmt: skip
        """The three sides as panels: values from the low to the high limit of the points that are seen."""

        def picture(points: Seen) -> str:
            covered, shades = points >= 0, np.zeros(points.shape, np.uint8)
            shades[covered] = np.maximum(indexed(values[points[covered]], *limits), 1)  # 0: nothing is there
            return address(shades, hollow(colours))

        size, panels = self.high - self.low, []
        names = ("x, m", "y, m", "z, m")
        for side, points in zip(SIDES, seen, strict=True):
            width, height = (float(size[k]) for k in (side.across, side.up))
            shares = height / width, width / float(size.max())
            ticks_down, ticks_across = (int(np.clip(round(4 * share), 2, 4)) for share in shares)
            down = axis(names[side.up], float(self.high[side.up]), float(self.low[side.up]), ticks_down)
            across = axis(names[side.across], float(self.low[side.across]), float(self.high[side.across]), ticks_across)
            panels.append(
                Panel(
                    side.name,
                    f"{title}, from the {side.name}",
                    across,
                    down,
                    aspect=width / height,
                    image=picture(points),
                    scale=scale_bar(width),
                )
            )
        return Block(title, tuple(panels), tuple(float(size[side.across]) for side in SIDES))


class Sight:
    """What is seen from a side, of points that are given some at a time and cover `size` × `size` pixels each."""

    def __init__(self, raster: Raster, side: Side, size: int = 1) -> None:
        self._raster, self._side = raster, side
        extent = raster.high - raster.low
        self._shape = [max(1, int(np.ceil(extent[axis] / raster.pixel_m))) for axis in (side.up, side.across)]
        self._near = np.full(self._shape, -np.inf).ravel()
        self._point = np.full(self._shape, -1).ravel()
        around = np.arange(size) - size // 2
        self._up, self._along = (step.ravel() for step in np.meshgrid(around, around))

    def add(self, first: int, places: Float[np.ndarray, "3 s"]) -> None:
        """More points, the first of which has that number; of equally near ones, the last is seen."""
        side, covered = self._side, len(self._up)
        row, column = (
            np.floor((places[k] - self._raster.low[k]) / self._raster.pixel_m).astype(np.int64)[:, None] + steps
            for k, steps in ((side.up, self._up), (side.across, self._along))
        )
        pixel = (row * self._shape[1] + column).ravel()
        near = np.repeat(side.sign * places[side.towards].astype(np.float64), covered)
        inside = (row >= 0) & (row < self._shape[0]) & (column >= 0) & (column < self._shape[1])
        drawn = np.flatnonzero(inside)
        drawn = drawn[near[drawn] >= self._near[pixel[drawn]]]  # few, once something is everywhere
        pixel, near = pixel[drawn], near[drawn]
        np.maximum.at(self._near, pixel, near)
        nearest = near == self._near[pixel]
        self._point[pixel[nearest]] = first + drawn[nearest] // covered

    @property
    def seen(self) -> Seen:
        """What is seen of the points added so far."""
        return self._point.reshape(self._shape)[::-1]
