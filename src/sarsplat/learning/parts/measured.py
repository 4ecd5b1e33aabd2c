"""Nuisances of measured images: shift and gain of each image; side lobes and a noise floor of all."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR
from sarsplat.learning.parts.part import Learned, Parameters, Part, Shot, drawn_like, normal_nats
from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.settings.config import Config


class Shifts(Part):
    """Displacement of each training image in azimuth and slant range, m: chips are centred on targets by eye.

    Unseen images get the mean displacement, and a response widened by the spread; or a random one.
    """

    order = 30
    section = "surroundings"

    @property
    def learned(self) -> dict[str, Learned]:
        rate = self.config.rates.shift * self.frame.cell_m if self.settings.shift_std else 0.0
        return {"shift": Learned((len(self.frame.views), 2), (rate,))}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
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


class Gains(Part):
    """Gain of the scattered power in each training image, of mean 1; unseen images get 1, or a random gain.

    Additive power is relative to the gain: in units of an unseen image, it is high where the gain is low.
    """

    order = 50
    section = "surroundings"

    @property
    def learned(self) -> dict[str, Learned]:
        rate = self.config.rates.nuisance if self.settings.gain_std else 0.0
        return {"log_gain": Learned((len(self.frame.views),), (rate,))}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
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
        # not by `render`, whose check would wait for a GPU; expanded, so that the gradient is summed column by column,
        # independent of torch's threads
        return images * gains(p)[shot.numbers, None, None, None].expand(-1, images.shape[1], 1, shot.grid.columns)


def gains(p: Parameters) -> Float[Tensor, " v"]:
    """Factors on the power of the training images, normalised to mean 1."""
    return torch.softmax(p["log_gain"], dim=0) * len(p["log_gain"])


class NoiseFloor(Part):
    """Log power added to every pixel."""

    order = 60
    section = "surroundings"

    @property
    def learned(self) -> dict[str, Learned]:
        return {"noise": Learned((1,), (self.config.rates.nuisance,), start=math.log(self.settings.noise_floor))}

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        floor = p["noise"].exp()
        if shot.additive is not None:
            floor = floor * shot.additive
        power = torch.arange(images.shape[1], device=images.device) == shot.power_channel
        # expanded, so that its gradient is summed column by column
        return images + (floor * power.to(images)[:, None, None]).expand(-1, 1, shot.grid.columns)


class SideLobes(Part):
    """Log power of the side lobes in azimuth and in range, relative to those of a usual window."""

    order = 40
    section = "surroundings"

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.surroundings is not None and config.surroundings.side_lobes > 0

    @property
    def learned(self) -> dict[str, Learned]:
        rates, start = (self.config.rates.nuisance,), math.log(self.settings.side_lobes)
        return {"log_side_lobes": Learned((2,), rates, start=start)}

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        return with_side_lobes(images.flatten(0, 1), p["log_side_lobes"].exp(), shot.grid).view_as(images)


def with_side_lobes(
    images: Float[Tensor, "v rows columns"], level: Float[Tensor, " 2"], grid: ImageGrid
) -> Float[Tensor, "v rows columns"]:
    """Add side lobes to power images of a Gaussian response.

    `level` is the power of the side lobes in azimuth and in range, relative to those of the grid's response, or of a
    −35 dB Taylor window if that has none; differentiable.
    """
    along_azimuth, along_range = _matrices(grid, images.dtype, images.device)
    azimuth, slant_range = level[:, None].expand(2, grid.columns)  # so that gradients are summed column by column
    return images + azimuth * (images @ along_azimuth) + slant_range * (along_range @ images)


@kept_on_device(maxsize=16)
def _matrices(grid: ImageGrid, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Symmetric convolution matrices along rows and columns, cached on the device."""
    response = grid.response if math.isfinite(grid.response.main_lobe) else TAYLOR
    matrices = []
    for count, spacing, width in zip((grid.columns, grid.rows), grid.spacing_m, grid.resolution_m, strict=True):
        peak, pixels = GAUSSIAN.density(np.zeros(1)) * spacing / width, np.arange(count)  # of the renderer's response
        row = peak * response.side_lobes(pixels * spacing / width)
        matrices.append(torch.from_numpy(row[np.abs(np.subtract.outer(pixels, pixels))]).float().to(device, dtype))
    return matrices[0], matrices[1]
