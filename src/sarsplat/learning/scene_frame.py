"""Quantities that training images and settings fix for a learned scene: region, unit, views, grid, and levels."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sarsplat.data import Dataset
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, Stack, Terrain, View
from sarsplat.radiometry import LEAST_POWER
from sarsplat.regions.outlines import usual_gamma0
from sarsplat.regions.stack_region import stack_region
from sarsplat.regions.target_region import levelled, target_region
from sarsplat.settings.config import Config

_USUAL_GAMMA0 = 0.5  # median γ⁰ of the pixels that stand out from the ground, in the unit "target"
_CALIBRATED = 0.7  # usual unit "target" of vehicles and buildings in calibrated images: 0.4 to 1.2
_MIN_ACROSS = 20  # minimum number of resolution cells across the target in multilooked images
_COARSE_SHARE = 0.75  # share of the iterations that the coarser levels take together; the rest is at full resolution


@dataclass(frozen=True)
class SceneFrame:
    """Region, unit of power, views, grid, terrain and stacks of a learned scene."""

    region: Region
    """Box that the target may occupy."""
    unit: float
    """Power that counts as 1: every γ⁰, the noise floor and P_min are in this unit (`Config.unit`)."""
    views: tuple[View, ...]
    grid: ImageGrid
    """Lengths in configurations are multiples of its resolution cell."""
    terrain: Terrain | None = None
    """Ground, relative to which z of the region counts; None is the plane z = 0."""
    stacks: tuple[Stack, ...] = ()
    """Stack of each view; empty if training uses power only."""

    @classmethod
    def of(cls, config: Config, dataset: Dataset) -> "SceneFrame":
        train = dataset.select("train")
        terrain = dataset.terrain if config.ground else None
        stacks = train.stacks if config.passes else ()
        if stacks:
            region = stack_region(train, config.box_m)
        else:
            region = target_region(dataset, ground=bool(config.ground or config.surroundings), box=config.box_m)
        if config.unit == "image" and (config.surroundings or stacks):
            unit = float(train.power.mean(dtype=np.float64))
        else:
            unit = usual_gamma0(levelled(train)) / _USUAL_GAMMA0
            if config.unit == "image":  # 1 for calibrated images
                unit = 10.0 ** round(math.log10(max(unit, LEAST_POWER) / _CALIBRATED))
        return cls(region, unit, train.views, train.grid, terrain, stacks)

    @property
    def cell_m(self) -> float:
        return self.grid.cell_m

    @property
    def samples(self) -> float:
        """Independent samples of speckle in all training images."""
        return len(self.views) * self.grid.independent_samples


@dataclass(frozen=True)
class Levels:
    """Coarse-to-fine schedule: level of the images that each iteration fits.

    A level is a factor f: images are means of power over blocks of f × f pixels. The first f is the largest power of
    two that leaves enough blocks across the target; each next one is half of it, the last one 1.
    """

    coarsest: int
    """Factor of the first level, a power of two."""
    iterations: int

    @classmethod
    def of(cls, config: Config, frame: SceneFrame) -> "Levels":
        grid, (width_m, depth_m, _) = frame.grid, frame.region.high - frame.region.low
        shown_m = (grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1])  # a box may be given, of any size
        across_m, factor = min(math.sqrt(width_m * depth_m), *shown_m), 1
        coarsest = min(config.coarsest, grid.rows, grid.columns)
        while 2 * factor <= coarsest and across_m >= _MIN_ACROSS * grid.multilooked(2 * factor).cell_m:
            factor *= 2
        return cls(factor, config.iterations)

    @property
    def _begins(self) -> list[int]:
        """First iteration of each level."""
        count = self.coarsest.bit_length() - 1
        return [0, *(math.ceil(_COARSE_SHARE * self.iterations * k / count) for k in range(1, count + 1))]

    def fine(self, iteration: int, share: float) -> bool:
        """True once this share of the iterations at full resolution has passed."""
        begin = self._begins[-1]
        return iteration >= begin + share * (self.iterations - begin)

    def left(self, step: int) -> float:
        """Share of the iterations at full resolution that are left after a number of steps that is no smaller."""
        return (self.iterations - step) / (self.iterations - self._begins[-1])

    def factor(self, iteration: int) -> int:
        """Level of an iteration, counted from 0."""
        return self.coarsest >> sum(begin <= iteration for begin in self._begins[1:])

    def begin_below(self, blocks: int) -> int:
        """First iteration with blocks smaller than `blocks`."""
        return next(begin for k, begin in enumerate(self._begins) if self.coarsest >> k < blocks)

    def growths(self, iterations: int) -> int:
        """Number of splits in the first `iterations`: one when each finer level begins, and one halfway to the next."""
        finer = self._begins[1:]
        return sum(one < iterations for one in {*finer, *((a + b) // 2 for a, b in pairwise(finer))})
