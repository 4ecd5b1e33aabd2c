"""Second bounce on level ground, with a learned mirror reflectivity."""

from __future__ import annotations

import torch

from sarsplat.data import Dataset
from sarsplat.gaussians.ground import Ground
from sarsplat.learning.parts.part import Learned, Parameters, Part, late
from sarsplat.renderer import GroundBounce
from sarsplat.renderer.echoes import Echo


class GroundBouncePart(Part):
    """Echo of the scene's Gaussians by way of the plane at z = 0, by their own scattering law."""

    order = 25
    section = "bounce"
    surrounds = True

    @property
    def learned(self) -> dict[str, Learned]:
        def later(done: float) -> float:
            return late(done) if done >= self.config.law_from else 0.0  # not before the shape is known

        return {"ground_reflectivity": Learned((1,), (self.config.rates.nuisance,), later, 0.0, 1.0)}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        start = torch.full((1,), self.settings.reflectivity, dtype=torch.float32, device="cpu")
        return {"ground_reflectivity": start}

    def echoes(self, p: Parameters) -> tuple[Echo, ...]:
        reflectivity = p["ground_reflectivity"][0]
        return (GroundBounce(Ground(torch.zeros_like(reflectivity)), reflectivity),)  # at z = 0
