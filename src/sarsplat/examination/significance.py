"""Tests of significance over many images: a difference counts if it is large and unlikely by chance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.special import stdtr

from sarsplat.data.orientation import SIDES
from sarsplat.names import Side

CHANCE = 1e-4
"""Probability, by Student's t-distribution, below which a difference is not one of chance."""

_FEWEST = 5
"""Images, or pairs of images: of fewer nothing is said."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of many images, or pairs of images, for one alternative."""

    values: Float64[np.ndarray, " n"]
    """One for each image or pair: positive for the alternative, negative against it."""

    @property
    def count(self) -> int:
        """Number of images or pairs; 0 if they are too few to say anything."""
        return len(self.values) if len(self.values) >= _FEWEST else 0

    @property
    def mean(self) -> float:
        """Mean over all; 0 if they are too few."""
        return float(self.values.mean()) if self.count else 0.0

    def supports(self, least: float, significance: float = CHANCE) -> bool:
        """Whether the mean exceeds `least`, and is positive not by chance."""
        if not self.count or self.mean <= least:
            return False
        error = float(self.values.std(ddof=1)) / math.sqrt(self.count)
        return error == 0 or bool(stdtr(self.count - 1, -self.mean / error) < significance)

    def against(self, least: float) -> bool:
        """Whether the mean is below −`least`, and negative not by chance."""
        return Evidence(-self.values).supports(least)


@dataclass(frozen=True)
class SideEvidence:
    """Evidence of many images, or pairs of images, for each side being the near one."""

    values: Float64[np.ndarray, "n 4"]
    """One row for each image or pair; top, right, bottom, left."""

    @property
    def count(self) -> int:
        """Number of images or pairs; 0 if they are too few to say anything."""
        return Evidence(self.values[:, 0]).count

    @property
    def strongest(self) -> Side:
        """The side with the largest mean, significant or not."""
        return SIDES[int(self.mean.argmax())]

    @property
    def mean(self) -> Float64[np.ndarray, " 4"]:
        """Mean of each side; 0 if there are too few."""
        return self.values.mean(axis=0) if self.count else np.zeros(4)

    @property
    def lead(self) -> float:
        """Mean of the strongest side, less that of the next."""
        next_best, best = np.sort(self.mean)[-2:]
        return float(best - next_best)

    def side(self, least: float, significance: float = CHANCE) -> Side | None:
        """The side that is ahead of each of the others by `least` and not by chance; None if there is none."""
        best = int(self.mean.argmax())
        others = np.delete(self.values, best, axis=1)
        ahead = [Evidence(self.values[:, best] - other).supports(least, significance) for other in others.T]
        return SIDES[best] if all(ahead) else None
