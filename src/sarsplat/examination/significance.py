"""Tests of significance over many images: a difference counts if it is large and unlikely by chance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.special import stdtr

from sarsplat.data.orientation import SIDES
from sarsplat.names import Side

CHANCE = 1e-4
"""Probability, by Student's t-distribution, below which a difference is not one of chance."""

_FEWEST = 5
"""Images, or pairs of images: of fewer nothing is said."""

_ONE_SIDED = 0.2
"""Length of the mean of directions (0 all round, 1 all the same) from which on what is the scene's own may be taken for
what the look does: below, it turns in the images and averages out."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of many images, or pairs of images, for one alternative."""

    values: Float64[np.ndarray, " n"]
    """One for each image or pair: positive for the alternative, negative against it."""
    directions: Float64[np.ndarray, "n 2"] | None = None
    """Unit vectors on the ground along which images look, if what lies in the scene counts as well: it turns with them,
    and what the look does is the same from everywhere. From one direction, a road beyond a car is as dark as its shadow
    in all images."""

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
        if self.directions is not None and np.linalg.norm(self.directions.mean(axis=0)) > _ONE_SIDED:
            return self._from_one_side(self.directions, significance)
        error = float(self.values.std(ddof=1)) / math.sqrt(self.count)
        return error == 0 or bool(stdtr(self.count - 1, -self.mean / error) < significance)

    def _from_one_side(self, directions: Float64[np.ndarray, "n 2"], significance: float) -> bool:
        """Whether what is left is positive, and not by chance, if the scene's own share is that of a slope in it."""
        share = np.column_stack([np.ones(self.count), directions])
        freedom = self.count - share.shape[1]
        if freedom < 1 or np.linalg.matrix_rank(share) < share.shape[1]:
            return False
        fitted = np.linalg.lstsq(share, self.values, rcond=None)[0]
        variance = float(((self.values - share @ fitted) ** 2).sum()) / freedom
        error = math.sqrt(variance * float(np.linalg.inv(share.T @ share)[0, 0]))
        return fitted[0] > 0 and (error == 0 or bool(stdtr(freedom, -fitted[0] / error) < significance))

    def against(self, least: float) -> bool:
        """Whether the mean is below −`least`, and negative not by chance."""
        return replace(self, values=-self.values).supports(least)


@dataclass(frozen=True)
class SideEvidence:
    """Evidence of many images, or pairs of images, for each side being the near one."""

    values: Float64[np.ndarray, "n 4"]
    """One row for each image or pair; top, right, bottom, left."""
    directions: Float64[np.ndarray, "n 2"] | None = None
    """As of `Evidence`."""

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
        ahead = [
            Evidence(self.values[:, best] - other, self.directions).supports(least, significance) for other in others.T
        ]
        return SIDES[best] if all(ahead) else None
