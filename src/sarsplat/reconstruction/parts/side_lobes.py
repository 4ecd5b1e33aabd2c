"""Side lobes of the response: how strong they are."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.parts.part import Learned, Nuisance, Parameters, Shot
from sarsplat.reconstruction.side_lobes import with_side_lobes


class SideLobes(Nuisance):
    """The logarithm of their power in azimuth and in range, relative to those of a usual window."""

    order = 40

    @classmethod
    def wanted(cls, config: Config) -> bool:
        """See `Part`."""
        return config.surroundings is not None and config.surroundings.side_lobes > 0

    @property
    def learned(self) -> dict[str, Learned]:
        """See `Part`."""
        return {"log_side_lobes": Learned((2,), (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        """See `Part`."""
        return {"log_side_lobes": torch.full((2,), math.log(self.settings.side_lobes), device="cpu")}

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        """See `Part`."""
        return with_side_lobes(images.flatten(0, 1), p["log_side_lobes"].exp(), shot.grid).view_as(images)
