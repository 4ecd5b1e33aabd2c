"""How DSR is trained; needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from sarsplat.baselines.config import BaselineConfig
from sarsplat.reconstruction.config import Count, NotNegative, Positive

Softness = Annotated[float, Meta(ge=1e-6, le=1)]
Momentum = Annotated[float, Meta(ge=0, le=0.9999)]


@dataclass(frozen=True)
class DsrConfig(BaselineConfig):
    """Settings of DSR.

    Parameters
    ----------
    vertices : {642, 1352}
        Of the template.
    sigma : float
        σ of the coverage, in squares of 1.58 longest sides of the target's box: √σ is the softness of edges.
    gamma : float
        How far a face may lie behind another and still be seen: e-fold in depth, in 99 longest sides of the box.
    laplacian, flatten, lit, shadow, image : float
        Weights of the losses.
    learning_rate : float
        Of the vertices, longest sides of the target's box per step; it falls tenfold in the whole training.
    scattering_rate : float
        Of the logarithms of scattering, ground and noise; it falls alike.
    betas : (float, float)
        Of Adam.
    iterations, checkpoint_every, views_per_step, seed
        As in `BaselineConfig`.

    Raises
    ------
    SarsplatError
        If a value is of another type or out of range.
    """

    vertices: Literal[642, 1352] = 642
    sigma: Softness = 1.2e-5
    gamma: Softness = 1e-4
    laplacian: NotNegative = 0.3
    flatten: NotNegative = 3e-4
    lit: NotNegative = 1.0
    shadow: NotNegative = 1.0
    image: NotNegative = 1.0
    iterations: Count = 2000
    views_per_step: Count = 4
    learning_rate: Positive = 0.01
    scattering_rate: Positive = 0.03
    betas: tuple[Momentum, Momentum] = (0.5, 0.99)


DSR = DsrConfig()
