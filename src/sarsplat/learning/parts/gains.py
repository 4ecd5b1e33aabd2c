"""Gains: a brightness factor for each measured image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.parts.part import Learned, Nuisance, Parameters, Shot, drawn_like, normal_nats


class Gains(Nuisance):
    """A factor on what is scattered in each training image; of mean 1, which is that of an unseen one unless drawn.

    Scaled to that, the power added to an image of little gain is high.
    """

    order = 50

    @property
    def learned(self) -> dict[str, Learned]:
        rate = self.config.rates.nuisance if self.settings.gain_std else 0.0
        return {"log_gain": Learned((len(self.frame.views),), (rate,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        return {"log_gain": torch.zeros(len(train), device="cpu")}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Prior: gains are near 1."""
        if self.settings.gain_std:
            yield normal_nats(p["log_gain"], self.settings.gain_std)

    def shot(self, shot: Shot, p: Parameters) -> Shot:
        if shot.numbers is not None:
            return shot
        if shot.rng is not None:
            return replace(shot, gain=drawn_like(gains(p).log(), len(shot.views), shot.rng).exp())
        return replace(shot, additive=gains(p).reciprocal().mean())

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        if shot.gain is not None:
            return images * shot.gain[:, None, None, None]
        if shot.numbers is None:
            return images
        # not by `render`, which would look at its values, and a GPU would be waited for; expanded, so that its gradient
        # is summed column by column: to one number, torch would split it by threads
        return images * gains(p)[shot.numbers, None, None, None].expand(-1, images.shape[1], 1, shot.grid.columns)


def gains(p: Parameters) -> Float[Tensor, " v"]:
    """Factors on the power of the training images, normalised to mean 1."""
    return torch.softmax(p["log_gain"], dim=0) * len(p["log_gain"])
