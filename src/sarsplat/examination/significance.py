"""Tests of significance over many images: a difference counts if it is large and unlikely by chance."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.special import stdtr

from sarsplat.data.orientation import SIDES
from sarsplat.names import Side

CHANCE = 1e-4
"""Significance level of Student's t-test."""

_MIN_COUNT = 5  # minimum number of images, or pairs of images

_MAX_MEAN_DIRECTION = 0.2
"""Length of the mean look direction (0 all round, 1 all the same) above which the scene's effects are fitted: below,
they turn in the images and average out."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of many images, or pairs of images, for one alternative."""

    values: Float64[np.ndarray, " n"]
    """Value of each image or pair: positive for the alternative, negative against it."""
    directions: Float64[np.ndarray, "n 2"] | None = None
    """Look directions on the ground, unit vectors, if the scene may look the same as the effect of the look: from one
    direction, a road behind a car is as dark as its shadow. None if it cannot."""

    @property
    def count(self) -> int:
        """Number of images or pairs; 0 if they are too few to say anything."""
        return len(self.values) if len(self.values) >= _MIN_COUNT else 0

    @property
    def mean(self) -> float:
        """Mean of the values; 0 if they are too few."""
        return float(self.values.mean()) if self.count else 0.0

    def supports(self, least: float, significance: float = CHANCE) -> bool:
        """Return whether the mean exceeds `least` and is significantly positive."""
        if not self.count or self.mean <= least:
            return False
        if self.directions is not None and np.linalg.norm(self.directions.mean(axis=0)) > _MAX_MEAN_DIRECTION:
            return self._supported_beside_scene(self.directions, significance)
        error = float(self.values.std(ddof=1)) / math.sqrt(self.count)
        return error == 0 or bool(stdtr(self.count - 1, -self.mean / error) < significance)

    def _supported_beside_scene(self, directions: Float64[np.ndarray, "n 2"], significance: float) -> bool:
        """Test the intercept of values ≈ intercept + slope · direction: the slope is the scene's effect."""
        design = np.column_stack([np.ones(self.count), directions])
        degrees_of_freedom = self.count - design.shape[1]
        if degrees_of_freedom < 1 or np.linalg.matrix_rank(design) < design.shape[1]:
            return False
        coefficients = np.linalg.lstsq(design, self.values, rcond=None)[0]
        variance = float(((self.values - design @ coefficients) ** 2).sum()) / degrees_of_freedom
        error = math.sqrt(variance * float(np.linalg.inv(design.T @ design)[0, 0]))
        return coefficients[0] > 0 and (
            error == 0 or bool(stdtr(degrees_of_freedom, -coefficients[0] / error) < significance)
        )

    def against(self, least: float) -> bool:
        """Return whether the mean is below −`least` and significantly negative."""
        return replace(self, values=-self.values).supports(least)


@dataclass(frozen=True)
class SideEvidence:
    """Evidence of many images, or pairs of images, for each side being the near one."""

    values: Float64[np.ndarray, "n 4"]
    """Values of each image or pair for top, right, bottom, left."""
    directions: Float64[np.ndarray, "n 2"] | None = None
    """Look directions, as in `Evidence`."""

    @property
    def count(self) -> int:
        """Number of images or pairs; 0 if they are too few to say anything."""
        return Evidence(self.values[:, 0]).count

    @property
    def mean(self) -> Float64[np.ndarray, " 4"]:
        """Mean of each side; 0 if the values are too few."""
        return self.values.mean(axis=0) if self.count else np.zeros(4)

    @property
    def lead(self) -> float:
        """Mean of the strongest side less that of the second."""
        next_best, best = np.sort(self.mean)[-2:]
        return float(best - next_best)

    def side(self, least: float, significance: float = CHANCE) -> Side | None:
        """Return the side significantly ahead of each other one by `least`, or None."""
        best = int(self.mean.argmax())
        others = np.delete(self.values, best, axis=1)
        ahead = [
            Evidence(self.values[:, best] - other, self.directions).supports(least, significance) for other in others.T
        ]
        return SIDES[best] if all(ahead) else None
