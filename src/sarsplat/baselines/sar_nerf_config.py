"""How SAR-NeRF is trained; needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from sarsplat.baselines.config import BaselineConfig
from sarsplat.reconstruction.config import Count, Degree, NotNegative, Positive


@dataclass(frozen=True)
class SarNerfConfig(BaselineConfig):
    """Settings of SAR-NeRF with its multi-layer perceptron.

    Parameters
    ----------
    mode : {"published", "sound"}
        The published image equation and loss, or those that hold in metres and for speckle.
    rays : int
        In elevation, for each azimuth column; if sound, over ground at least one per resolution cell.
    learning_rate : float
        Of Adam; it falls tenfold in the whole training.
    surface_voxels : int
        Along the longest side of the box in which the surface is looked for.
    iterations, checkpoint_every, views_per_step, seed
        As in `BaselineConfig`.

    Raises
    ------
    SarsplatError
        If a value is of another type or out of range.
    """

    mode: Literal["published", "sound"] = "published"
    rays: Annotated[int, Meta(ge=1, le=1000)] = 20
    iterations: Count = 250_000
    checkpoint_every: Count = 10
    learning_rate: Positive = 5e-4
    surface_voxels: Annotated[int, Meta(ge=4, le=1024)] = 256


@dataclass(frozen=True)
class SarNerfGridConfig(SarNerfConfig):
    """Settings of SAR-NeRF with nested grids instead.

    Parameters
    ----------
    voxel : float
        Of the finest level of the grid in the target's box, resolution cells; on the ground around it, it is 1.
    levels : int
        Of the grid; each is half as fine as the next.
    degree : int
        Of the spherical harmonics in the grid; if sound, for speckled images less if they are fewer than two for each.
    total_variation : float
        Of the grid, if sound and for speckled images: nats that the squared difference of two neighbouring numbers
        costs beside the likelihood of all training images; 0.5 is a normal distribution of standard deviation 1.
    mode, rays, learning_rate, surface_voxels, iterations, checkpoint_every, views_per_step, seed
        As in `SarNerfConfig`.

    Raises
    ------
    SarsplatError
        If a value is of another type or out of range.
    """

    mode: Literal["published", "sound"] = "sound"
    iterations: Count = 4000
    checkpoint_every: Count = 100
    learning_rate: Positive = 0.2
    voxel: Positive = 0.5
    levels: Annotated[int, Meta(ge=1, le=10)] = 4
    degree: Degree = 2
    total_variation: NotNegative = 0.5


SAR_NERF = SarNerfConfig()
SAR_NERF_GRID = SarNerfGridConfig()
