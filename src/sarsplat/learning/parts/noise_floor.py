"""Noise floor: power that measured images show where nothing scatters."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.parts.part import Learned, Nuisance, Parameters, Shot


class NoiseFloor(Nuisance):
    """The logarithm of a power that is added to every pixel."""

    order = 60

    @property
    def learned(self) -> dict[str, Learned]:
        return {"noise": Learned((1,), (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        return {"noise": torch.full((1,), math.log(self.settings.noise_floor), device="cpu")}

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        floor = p["noise"].exp()
        if shot.additive is not None:
            floor = floor * shot.additive
        power = torch.arange(images.shape[1], device=images.device) == shot.power_channel
        # expanded, so that its gradient is summed column by column
        return images + (floor * power.to(images)[:, None, None]).expand(-1, 1, shot.grid.columns)
