"""Noise of the passes of stacks: known, or learned."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.parts.part import Learned, Parameters, Part, Shot
from sarsplat.settings.config import Config


class PassNoise(Part):
    """Power of each pass where nothing scatters; its logarithm is learned unless the stacks say it."""

    order = 60

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.passes is not None

    @property
    def learned(self) -> dict[str, Learned]:
        if self._known is not None:
            return {}
        return {"pass_noise": Learned(self._shape, (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        assert self.config.passes is not None  # `wanted`
        start = torch.full(self._shape, math.log(self.config.passes.noise), device="cpu")
        return dict.fromkeys(self.learned, start)

    def of_passes(self, p: Parameters) -> Float[Tensor, "v passes"]:
        """Noise power of the passes of each training image, in the model's unit."""
        return p["pass_noise"].exp() if self._known is None else self._known

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        """The mean over all passes: unseen images have no noise of their own."""
        return images + self.of_passes(p).mean(1).mean(0)

    def noise(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p"]:
        """Noise power; for unseen images the mean over all passes, as in `images`, a single number."""
        noise = self.of_passes(p)
        return noise.mean().expand(1, 1) if shot.numbers is None else noise[shot.numbers]

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self.frame.stacks), len(self.frame.stacks[0])

    @property
    def _known(self) -> Float[Tensor, "v passes"] | None:
        noise = [stack.noise for stack in self.frame.stacks]
        if None in noise:
            return None
        return torch.tensor(noise, dtype=torch.float64).div(self.frame.unit).float().to(self.device)
