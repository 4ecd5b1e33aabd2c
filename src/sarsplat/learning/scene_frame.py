"""Quantities that the training images fix for a learned scene: region, unit, views, grid, terrain, stacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sarsplat.data import Dataset
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, Stack, Terrain, View
from sarsplat.regions.outlines import usual_gamma0
from sarsplat.regions.stack_region import stack_region
from sarsplat.regions.target_region import levelled, target_region
from sarsplat.settings.config import Config

_USUAL_GAMMA0 = 0.5
"""Median γ⁰ of the pixels that stand out from the ground, in the unit "target"."""


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
    def of(cls, config: Config, dataset: Dataset) -> SceneFrame:
        train = dataset.select("train")
        terrain = dataset.terrain if config.ground else None
        stacks = train.stacks if config.passes else ()
        if stacks:
            region = stack_region(train, config.box_m)
        else:
            region = target_region(dataset, ground=bool(config.ground or config.surroundings), box=config.box_m)
        if config.unit == "target":
            unit = usual_gamma0(levelled(train)) / _USUAL_GAMMA0
        else:
            unit = float(train.power.mean(dtype=np.float64)) if config.surroundings or stacks else 1.0
        return cls(region, unit, train.views, train.grid, terrain, stacks)

    @property
    def cell_m(self) -> float:
        return self.grid.cell_m

    @property
    def samples(self) -> float:
        """Independent samples of speckle in all training images."""
        return len(self.views) * self.grid.independent_samples
