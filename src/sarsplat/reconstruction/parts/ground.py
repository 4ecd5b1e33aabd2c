"""The ground: an opaque sheet of Gaussians that stay where they are and scatter more or less."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.gaussians import Gaussians, Scattering
from sarsplat.gaussians.ground import ground_sheet
from sarsplat.radiometry import beta0_of_gamma0
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.parts.part import Learned, Nuisance, Parameters, normal_nats
from sarsplat.reconstruction.parts.target import law
from sarsplat.renderer import Bounds


class Ground(Nuisance):
    """A disc at z = 0: one law of scattering for all of it, and a difference in level for each of its Gaussians."""

    order = 20
    surrounds = True

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.surroundings is not None and config.surroundings.ground_pitch > 0

    @property
    def learned(self) -> dict[str, Learned]:
        rates = self.config.rates
        return {
            "ground": Learned((self._law.parameters.shape[1],), (rates.nuisance,)),
            "ground_texture": Learned((len(self._sheet), 1), (rates.ground if self.settings.ground_std else 0.0,)),
        }

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        mean_tangent = float(np.mean([beta0_of_gamma0(1.0, view.grazing_deg) for view in train.views]))
        # γ⁰ of single-look clutter, from its median
        level = float(np.median(train.power)) / self.setting.unit / math.log(2) / mean_tangent
        texture = torch.zeros(len(self._sheet), 1, device="cpu")
        return {"ground": law(self.config, 1, level).parameters[0], "ground_texture": texture}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Its Gaussians are similar."""
        if self.settings.ground_std:
            yield normal_nats(p["ground_texture"], self.settings.ground_std)

    def scene(
        self, scene: Gaussians | None, p: Parameters, degree: int, dropped: Bool[Tensor, " n"] | None
    ) -> Gaussians:
        uniform = p["ground"].expand(len(self._sheet), -1)
        # only its level is learned: images of one grazing angle cannot say how γ⁰ goes on at others
        level = torch.cat([uniform[:, :1] + p["ground_texture"], uniform[:, 1:].detach()], dim=1)
        ground = replace(self._sheet, scattering=replace(self._law, parameters=level).detailed(degree))
        return ground if scene is None else Gaussians.cat([scene, ground])

    def reach(self) -> Bounds:
        sheet = self._made
        low, high = sheet.means.amin(0).tolist(), sheet.means.amax(0).tolist()
        return Bounds((*low,), (*high,), float(sheet.scales.max()), float(sheet.optical_depth.max()), "cpu")

    @cached_property
    def _law(self) -> Scattering:
        return law(self.config, 1, 0.0)

    @cached_property
    def _made(self) -> Gaussians:
        return ground_sheet(self.setting.ground_radius_m, self.settings.ground_pitch * self.setting.cell_m)

    @cached_property
    def _sheet(self) -> Gaussians:
        return self._made.to(self.device)
