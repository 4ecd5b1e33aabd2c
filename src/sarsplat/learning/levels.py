"""Coarse-to-fine schedule: which multilooked level of the images each iteration is fitted to.

A level is a factor f: images are means of power over blocks of f × f pixels. The first has the largest power of two
that leaves the target enough such blocks across, each next one half of it, the last one 1. A small target has that one
alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from sarsplat.geometry import ImageGrid
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.settings.config import Config

_ACROSS = 20
"""Resolution cells across the target, at least, in multilooked images: in fewer, its parts are not told apart."""

_UNTIL = 0.75
"""Share of the iterations after which the images themselves are looked at; coarser levels share the time before."""


@dataclass(frozen=True)
class Levels:
    """The schedule of levels: blocks of pixels that each iteration's images are averaged over."""

    coarsest: int
    """Factor of the first level, a power of two."""
    grid: ImageGrid
    """Of the images themselves."""
    iterations: int
    """Of the whole training."""

    @classmethod
    def of(cls, config: Config, frame: SceneFrame) -> Levels:
        grid, (width_m, depth_m, _) = frame.grid, frame.region.high - frame.region.low
        shown_m = (grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1])  # a box may be given, of any size
        across_m, factor = min(math.sqrt(width_m * depth_m), *shown_m), 1
        coarsest = min(config.coarsest, grid.rows, grid.columns)
        while 2 * factor <= coarsest and across_m >= _ACROSS * grid.multilooked(2 * factor).cell_m:
            factor *= 2
        return cls(factor, grid, config.iterations)

    @property
    def _begins(self) -> list[int]:
        """First iteration of each level."""
        count = self.coarsest.bit_length() - 1
        return [0, *(math.ceil(_UNTIL * self.iterations * k / count) for k in range(1, count + 1))]

    def fine(self, iteration: int, share: float) -> bool:
        """Whether this share of the iterations at full resolution has passed."""
        begin = self._begins[-1]
        return iteration >= begin + share * (self.iterations - begin)

    def factor(self, iteration: int) -> int:
        """The level of an iteration, the first being 0."""
        return self.coarsest >> sum(begin <= iteration for begin in self._begins[1:])

    def begin_below(self, blocks: int) -> int:
        """First iteration whose images are averaged over smaller blocks than these; 0 if all are."""
        return next(begin for k, begin in enumerate(self._begins) if self.coarsest >> k < blocks)

    def growths(self, iterations: int) -> int:
        """How often Gaussians are split in so many: in the first of each finer level, and halfway to the next."""
        finer = self._begins[1:]
        return sum(one < iterations for one in {*finer, *((a + b) // 2 for a, b in pairwise(finer))})

    def grid_at(self, factor: int) -> ImageGrid:
        """Pixels and response of the images of a level."""
        return self.grid.multilooked(factor)
