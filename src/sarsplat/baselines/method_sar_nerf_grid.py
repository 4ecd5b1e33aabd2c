"""SAR-NeRF with nested grids instead of a perceptron, for a CPU; docs/concepts/baselines-sar-nerf.md."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from sarsplat.baselines.fields import VoxelGrid
from sarsplat.baselines.method import BaselineMethod
from sarsplat.baselines.method_sar_nerf import LOSS, SarNerf, SarNerfConfig
from sarsplat.settings.kinds import Count, Degree, NotNegative, Positive

_VIEWS_PER_HARMONIC = 2  # minimum number of speckled training images per spherical harmonic


@dataclass(frozen=True)
class SarNerfGridConfig(SarNerfConfig):
    """Settings of SAR-NeRF with nested grids instead."""

    mode: Literal["published", "sound"] = "sound"
    iterations: Count = 4000
    checkpoint_every: Count = 100
    learning_rate: Positive = 0.2
    voxel: Positive = 0.5
    """Spacing of the finest lattice in the target's box, resolution cells; on the ground around it, it is 1."""
    levels: Annotated[int, Meta(ge=1, le=10)] = 4
    """Number of lattices of each box, each with twice the spacing of the next."""
    degree: Degree = 2
    """Maximum degree of the spherical harmonics; if sound, speckled images allow one harmonic per two images."""
    total_variation: NotNegative = 0.5
    """Weight of squared differences of neighbouring numbers, nats, for speckled images if sound; 0.5 is a normal prior
    of standard deviation 1."""


class SarNerfGrid(SarNerf):
    """SAR-NeRF whose field is a `VoxelGrid`, limited to its boxes."""

    config: SarNerfGridConfig
    field: VoxelGrid
    start = (0.02, -4.0)  # the grid starts at 0, where ReLU has no gradient
    endless = False

    def _new_field(self) -> VoxelGrid:
        cell, degree = self.scene.grid.cell_m, self.config.degree
        if self._speckled:  # higher degrees would fit the speckle of single images
            degree = max(0, min(degree, math.isqrt(len(self.scene.views) // _VIEWS_PER_HARMONIC) - 1))
        target, *ground = self._boxes
        boxes = [(*target, self.config.voxel * cell), *((*box, cell) for box in ground)]
        return VoxelGrid(boxes, self.config.levels, degree)

    def _prior(self, samples: float) -> Float[Tensor, ""]:
        return self.config.total_variation / samples * self.field.total_variation()


METHOD = BaselineMethod(
    "sar-nerf-grid",
    "SAR-NeRF on a grid",
    "nested grids of attenuation and scattering",
    LOSS,
    SarNerfGridConfig(),
    SarNerfGrid,
)
