"""Three sides of a target, as on a drawing board, from pictures of what the world holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from sarsplat.colours import hollow
from sarsplat.report.figure import Block, Panel, axis, scale_bar
from sarsplat.report.raster import data_uri, indexed, png

Corner = Float[np.ndarray, " 3"]


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
        """With so many pixels along the longest side."""
        return cls(low, high, float((high - low).max()) / pixels)

    def nearest(
        self, points: Float[np.ndarray, "p 3"], side: Side, size: int = 1
    ) -> tuple[Int64[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
        """Index of the point that is seen in each pixel from a side, row 0 at the top, and whether there is one.

        A point covers `size` × `size` pixels.
        """
        across, up = side.across, side.up
        shape = [max(1, int(np.ceil((self.high - self.low)[axis] / self.pixel_m))) for axis in (up, across)]
        place = np.floor((points[:, (up, across)] - self.low[[up, across]]) / self.pixel_m).astype(int)
        far_first = np.argsort(side.sign * points[:, side.towards], kind="stable")
        around = np.stack(np.meshgrid(*2 * [np.arange(size) - size // 2]), axis=-1).reshape(-1, 2)
        place = (place[far_first, None] + around).reshape(-1, 2)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        seen = np.full(shape, -1)
        seen[tuple(place[inside].T)] = np.repeat(far_first, size**2)[inside]
        return seen[::-1], seen[::-1] >= 0

    def board(
        self, title: str, points: Float[np.ndarray, "p 3"], values: Float[np.ndarray, " p"],
        limits: tuple[float, float], colours: str, width_m: float = 0.0,
    ) -> Block:  # fmt: skip
        """The three sides as panels: values from the low to the high limit, of points that are so wide, m."""
        indices = np.maximum(indexed(values, *limits), 1)  # 0: nothing is there

        def picture(side: Side) -> str:
            seen, covered = self.nearest(points, side, int(np.clip(np.ceil(width_m / self.pixel_m), 1, _WIDEST)))
            shades = np.zeros(seen.shape, np.uint8)
            shades[covered] = indices[seen[covered]]
            return data_uri(png(shades, hollow(colours)))

        size, panels = self.high - self.low, []
        names = ("x, m", "y, m", "z, m")
        for side in SIDES:
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
                    image=picture(side),
                    scale=scale_bar(width),
                )
            )
        return Block(title, tuple(panels), tuple(float(size[side.across]) for side in SIDES))
