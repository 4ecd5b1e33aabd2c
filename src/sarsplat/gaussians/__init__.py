"""The scene model: parameters, covariance, scattering."""

from sarsplat.gaussians.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, join
from sarsplat.gaussians.scattering import Harmonics, NormalLobes, Scattering

SCATTERINGS: dict[str, type[Scattering]] = {law.kind: law for law in (Harmonics, NormalLobes)}
"""Laws of scattering by their names in files and configurations."""

__all__ = [
    "MAX_OPTICAL_DEPTH",
    "MIN_SCALE",
    "SCATTERINGS",
    "Gaussians",
    "Harmonics",
    "NormalLobes",
    "Scattering",
    "join",
]
