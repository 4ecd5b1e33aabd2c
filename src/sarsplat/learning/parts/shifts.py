"""Shifts: a displacement of each measured image, since chips are cut out around their targets by eye."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.learning.parts.part import Learned, Nuisance, Parameters, Shot, drawn_like, normal_nats


class Shifts(Nuisance):
    """A displacement in azimuth and slant range of each training image, m.

    An unseen one is displaced as the mean of them, and its response widened by their spread; or drawn from them.
    """

    order = 30

    @property
    def learned(self) -> dict[str, Learned]:
        rate = self.config.rates.shift * self.frame.cell_m if self.settings.shift_std else 0.0
        return {"shift": Learned((len(self.frame.views), 2), (rate,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        return {"shift": torch.zeros(len(train), 2, device="cpu")}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Prior: shifts are small."""
        if self.settings.shift_std:
            yield normal_nats(p["shift"], self.settings.shift_std * self.frame.cell_m)

    def shot(self, shot: Shot, p: Parameters) -> Shot:
        if shot.numbers is not None:
            return replace(shot, shift=p["shift"][shot.numbers])
        if shot.rng is not None:
            return replace(shot, shift=drawn_like(p["shift"], len(shot.views), shot.rng))
        widened = shot.grid.widened(*p["shift"].detach().var(dim=0, correction=0).tolist())
        return replace(shot, grid=widened, shift=p["shift"].mean(0).expand(len(shot.views), 2))

    def displaced(self, grid: ImageGrid, p: Parameters) -> ImageGrid:
        azimuth, slant_range = p["shift"].detach().mean(0).tolist()
        return replace(grid, center_m=(grid.center_m[0] - azimuth, grid.center_m[1] - slant_range))
