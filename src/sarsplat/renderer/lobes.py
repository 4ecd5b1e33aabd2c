"""Amplitudes of Gaussians towards views, of the default scattering law by an engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians, NormalLobes
from sarsplat.geometry import View
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.engines.problem import directions_to


def amplitudes_towards(new_pass: NewPass | None, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v n c"]:
    """Return `Gaussians.amplitudes` towards the radar of each view, by an engine; by plain torch if None."""
    return amplitudes_along(new_pass, gaussians, directions_to(views, gaussians.means))


def amplitudes_along(
    new_pass: NewPass | None, gaussians: Gaussians, directions: Float[Tensor, "v 3"]
) -> Float[Tensor, "v n c"]:
    """Return `Gaussians.amplitudes` along unit vectors, by an engine; by plain torch if None."""
    law = gaussians.scattering
    if type(law) is not NormalLobes:
        return gaussians.amplitudes(directions)
    inputs = directions, gaussians.quaternions, gaussians.scales, law.parameters
    return Lobes(law.p_min).on(new_pass, *inputs)


class Lobes(Operation):
    """Operation of `NormalLobes.amplitudes`, without a gradient of the scales."""

    operation = "normal_lobes"
    names = ("directions", "quaternions", "scales", "parameters")

    def __init__(self, p_min: float) -> None:
        self.p_min = p_min

    def plain(
        self,
        directions: Float[Tensor, "v 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        parameters: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "v n 1"]:
        return NormalLobes(parameters, self.p_min).amplitudes(directions, quaternions, scales)

    def numbers(self, directions: Tensor, quaternions: Tensor, *_: Tensor) -> dict[str, Any]:
        return {"views": len(directions), "p_min": self.p_min, "gaussians": len(quaternions)}

    def outputs(self, directions: Tensor, quaternions: Tensor, *_: Tensor) -> dict[str, Tensor]:
        return {"amplitudes": directions.new_empty(len(directions), len(quaternions), 1)}
