"""A Gaussian: the renderer uses one with the 3 dB width of the response, whatever its shape."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sarsplat.geometry.responses.response import Response, variance_of

_SIGMAS = 8.0  # standard deviations at which it ends: e⁻³² of the peak


@dataclass(frozen=True)
class Gaussian(Response):
    """A Gaussian: no side lobes."""

    kind = "gaussian"

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Distances in standard deviations, and the power there."""
        distance = np.linspace(0.0, _SIGMAS, 513)
        return distance, np.exp(-(distance**2) / 2)

    def density(
        self, distance: Float64[np.ndarray, "*n"], variance: float = variance_of(1.0)
    ) -> Float64[np.ndarray, "*n"]:
        """|h|² in closed form."""
        return np.exp(-(distance**2) / (2 * variance)) / math.sqrt(2 * math.pi * variance)


GAUSSIAN = Gaussian()
"""The default response."""
