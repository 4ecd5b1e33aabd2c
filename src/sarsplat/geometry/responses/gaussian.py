"""Gaussian response; the renderer uses the Gaussian of the same 3 dB width for every response."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sarsplat.geometry.responses.response import Response, variance_of

_SIGMAS = 8.0  # end of the table in standard deviations: e⁻³² of the peak


@dataclass(frozen=True)
class Gaussian(Response):
    """Gaussian response, without side lobes."""

    kind = "gaussian"

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return distances in standard deviations, and the power there."""
        distance = np.linspace(0.0, _SIGMAS, 513)
        return distance, np.exp(-(distance**2) / 2)

    def density(
        self, distance: Float64[np.ndarray, "*n"], variance: float = variance_of(1.0)
    ) -> Float64[np.ndarray, "*n"]:
        """Evaluate |h|² in closed form."""
        return np.exp(-(distance**2) / (2 * variance)) / math.sqrt(2 * math.pi * variance)


GAUSSIAN = Gaussian()
"""Default response."""
