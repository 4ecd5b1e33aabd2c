"""A response as a table, for instance one measured at a corner reflector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry.responses.response import Response

_MOST = 65536


@dataclass(frozen=True)
class Sampled(Response):
    """A response between whose samples power runs straight.

    Parameters
    ----------
    distances : sequence of float
        From the peak, rising from 0, in any unit: only the shape counts.
    powers : sequence of float
        Power at these distances, in any unit, ≥ 0; the first is the largest, and the last is below half of it.

    Raises
    ------
    SarsplatError
        If they are no such table.
    """

    kind = "sampled"
    distances: Sequence[float]
    powers: Sequence[float]

    def __post_init__(self) -> None:
        for name in ("distances", "powers"):
            values = self._numbers(name)
            if values.shape != (len(values),) or not 2 <= len(values) <= _MOST or not np.isfinite(values).all():
                raise SarsplatError(
                    f"{name} of a sampled response must be 2 to {_MOST} finite numbers, not an array of shape "
                    f"{values.shape} from {values.min(initial=0):g} to {values.max(initial=0):g}; give one for each "
                    "sample"
                )
            object.__setattr__(self, name, tuple(values.tolist()))  # hashable, and fits into JSON
        distance, power = self.table()
        if len(distance) != len(power) or distance[0] != 0 or not (np.diff(distance) > 0).all():
            raise SarsplatError(
                f"{len(distance)} distances of a sampled response from {distance[0]:g} to {distance[-1]:g} must be as "
                f"many as its powers ({len(power)}) and rise from 0; sort them"
            )
        if power.min() < 0 or not power[0] == power.max() > 0 or not power[-1] < power[0] / 2:
            raise SarsplatError(
                f"powers of a sampled response from {power.min():g} to {power.max():g} must be positive, begin with "
                f"the largest and end below half of it, not {power[0]:g} and {power[-1]:g}; give linear power from the "
                "peak outwards"
            )

    def _numbers(self, name: str) -> Float64[np.ndarray, "*n"]:
        try:
            return np.asarray(getattr(self, name), np.float64)
        except (TypeError, ValueError) as error:
            raise SarsplatError(f"{name} of a sampled response must be numbers ({error}); give a list") from error

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """As given."""
        return np.array(self.distances), np.array(self.powers)
