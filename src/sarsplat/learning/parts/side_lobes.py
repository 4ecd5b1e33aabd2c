"""Side lobes of the response: the power of a bright scatterer along its row and its column."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR, Response
from sarsplat.learning.parts.part import Learned, Parameters, Part, Shot
from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.settings.config import Config


class SideLobes(Part):
    """Log power of the side lobes in azimuth and in range, relative to those of a usual window."""

    order = 40
    section = "surroundings"

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.surroundings is not None and config.surroundings.side_lobes > 0

    @property
    def learned(self) -> dict[str, Learned]:
        return {"log_side_lobes": Learned((2,), (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        return {
            "log_side_lobes": torch.full((2,), math.log(self.settings.side_lobes), dtype=torch.float32, device="cpu")
        }

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
    sizes = zip((grid.columns, grid.rows), grid.spacing_m, grid.resolution_m, strict=True)
    return tuple(_matrix(response, *size).to(device, dtype) for size in sizes)  # type: ignore[return-value]


def _matrix(response: Response, count: int, spacing_m: float, width_m: float) -> Float[Tensor, "{count} {count}"]:
    distance = np.arange(count) * spacing_m / width_m
    peak = GAUSSIAN.density(np.zeros(1)) * spacing_m / width_m  # of the renderer's response
    row = peak * response.side_lobes(distance)
    return torch.from_numpy(row[np.abs(np.subtract.outer(np.arange(count), np.arange(count)))]).float()
