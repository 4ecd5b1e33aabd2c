"""The scene model: parameters, covariance, scattering."""

from pkgutil import resolve_name

from sarsplat.gaussians.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, join
from sarsplat.gaussians.scattering import Harmonics, NormalLobes, Scattering
from sarsplat.names import SCATTERING_LAWS

SCATTERINGS: dict[str, type[Scattering]] = {kind: resolve_name(home) for kind, home in SCATTERING_LAWS.items()}
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
