"""How SAR-NeRF is trained; needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from sarsplat.reconstruction.config import Count, Degree, NotNegative, Positive
from sarsplat.rivals.config import RivalConfig


@dataclass(frozen=True)
class SarNerfConfig(RivalConfig):
    """Settings of SAR-NeRF, those of the multi-layer perceptron where nothing else is said.

    Parameters
    ----------
    field : {"mlp", "grid"}
        What attenuation and scattering are read from.
    mode : {"published", "sound"}
        The published image equation and loss, or those that hold in metres and for speckle.
    rays : int
        In elevation, for each azimuth column; if sound, over ground at least one per resolution cell.
    learning_rate : float
        Of Adam; it falls tenfold in the whole training.
    voxel : float
        Of the finest level of the grid in the target's box, resolution cells; on the ground around it, it is 1.
    levels : int
        Of the grid; each is half as fine as the next.
    degree : int
        Of the spherical harmonics in the grid; if sound, for speckled images less if they are fewer than two for each.
    total_variation : float
        Of the grid, if sound and for speckled images: nats that the squared difference of two neighbouring numbers
        costs beside the likelihood of all training images; 0.5 is a normal distribution of standard deviation 1.
    surface_voxels : int
        Along the longest side of the box in which the surface is looked for.
    iterations, checkpoint_every, views_per_step, seed
        As in `RivalConfig`.

    Raises
    ------
    SarsplatError
        If a value is of another type or out of range.
    """

    field: Literal["mlp", "grid"] = "mlp"
    mode: Literal["published", "sound"] = "published"
    rays: Annotated[int, Meta(ge=1, le=1000)] = 20
    iterations: Count = 250_000
    learning_rate: Positive = 5e-4
    voxel: Positive = 0.5
    levels: Annotated[int, Meta(ge=1, le=10)] = 4
    degree: Degree = 2
    total_variation: NotNegative = 0.5
    surface_voxels: Annotated[int, Meta(ge=4, le=1024)] = 256


SAR_NERF = SarNerfConfig(checkpoint_every=10)
SAR_NERF_GRID = SarNerfConfig(field="grid", mode="sound", iterations=4000, learning_rate=0.2)
