"""The ground, whose γ⁰ is learned: the plane at z = 0 or the dataset's terrain; and the second bounce by way of it."""

import math
from collections.abc import Iterator
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import Terrain
from sarsplat.geometry.view import ground_radius_m
from sarsplat.learning.parts.part import Learned, Parameters, Part, late, normal_nats
from sarsplat.radiometry import from_db
from sarsplat.regions.image_levels import ground_levels_db
from sarsplat.renderer import GroundBounce
from sarsplat.renderer.echoes import Echo

_FAINTEST = 0.01  # minimum initial level, relative to the mean power: a logarithm could not rise from black images
_MAX_SIDE = 512  # maximum number of places along a side of the γ⁰ map
_MIN_SPREAD = 0.05  # minimum standard deviation of log sin θ (1° at 17°) from which on its exponent is learned


class FlatGroundPart(Part):
    """Log γ⁰ of the ground: its mean, a map relative to the mean, and the exponent of its law of sin θ."""

    order = 20
    section = "ground"
    surrounds = True

    @property
    def learned(self) -> dict[str, Learned]:
        rates = self.config.rates
        own = {
            "ground": Learned((1,), (rates.nuisance,)),
            "ground_exponent": Learned((1,), (rates.nuisance if self._sines.std() > _MIN_SPREAD else 0.0,)),
        }
        places = {"ground_texture": Learned((self._side**2, 1), (rates.ground,))} if self._side else {}
        return own | places

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        mean_tangent = float(np.mean([view.look.beta0_of_gamma0(1.0) for view in train.views]))
        level, brightness = float(np.median(train.power)), float(train.power.mean(dtype=np.float64))
        if train.looks is not None:
            level /= (1 - 1 / (9 * train.looks)) ** 3  # the median of gamma-distributed power, in means
        level = max(level, _FAINTEST * brightness) / self.frame.unit / mean_tangent
        first = {
            "ground": torch.full((1,), math.log(level), dtype=torch.float32, device="cpu"),
            "ground_exponent": torch.zeros(1, dtype=torch.float32, device="cpu"),
        }
        if self._side:
            texture = np.zeros((self._side, self._side))
            if self.settings.from_images:
                axis = (np.arange(self._side) - (self._side - 1) / 2) * self._pitch_m
                texture = np.log(from_db(ground_levels_db(train, *np.meshgrid(axis, axis))))
            first["ground_texture"] = torch.from_numpy(texture.reshape(-1, 1)).float()
        return first

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Prior: neighbouring places have similar γ⁰."""
        if self._side:
            yield normal_nats(p["ground_texture"], self.settings.std)

    def ground(self, p: Parameters) -> Ground:
        exponent = p["ground_exponent"][0]
        level = p["ground"][0] - exponent * float(self._sines.mean())  # `ground` is at the mean angle
        if not self._side:
            return Ground(level.exp(), height_m=self._height_m, exponent=exponent)
        places = (level + p["ground_texture"].view(self._side, self._side)).exp()
        return Ground(places, self._pitch_m, self._height_m, exponent)

    @property
    def _height_m(self) -> float | Terrain:
        return 0.0 if self.frame.terrain is None else self.frame.terrain

    @cached_property
    def _sines(self) -> np.ndarray:
        """Logarithms of sin θ of the training views."""
        return np.log([view.look.sine for view in self.frame.views])

    @cached_property
    def _pitch_m(self) -> float:
        """Spacing of the map, m: as configured, but wider in large scenes to limit its size."""
        return max(self.settings.pitch * self.frame.cell_m, 2 * self._radius_m / _MAX_SIDE)

    @cached_property
    def _side(self) -> int:
        """Number of places along a side; 0 without a map."""
        return 2 * math.ceil(self._radius_m / self._pitch_m) + 1 if self.settings.pitch else 0

    @property
    def _radius_m(self) -> float:
        return ground_radius_m(self.frame.views, self.frame.grid)


class GroundBouncePart(Part):
    """Echo of the scene's Gaussians by way of the plane at z = 0, a mirror of learned reflectivity."""

    order = 25
    section = "bounce"
    surrounds = True

    @property
    def learned(self) -> dict[str, Learned]:
        rates, start = (self.config.rates.nuisance,), self.settings.reflectivity
        decay = partial(late, begin=self.config.law_from)  # not before the shape is known
        return {"ground_reflectivity": Learned((1,), rates, decay, 0.0, 1.0, start=start)}

    def echoes(self, p: Parameters) -> tuple[Echo, ...]:
        reflectivity = p["ground_reflectivity"][0]
        return (GroundBounce(Ground(torch.zeros_like(reflectivity)), reflectivity),)  # at z = 0
