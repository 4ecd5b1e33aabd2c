"""Scene model: Gaussians, their scattering laws, and ground."""

from sarsplat.gaussians.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.gaussians.law_harmonics import Harmonics
from sarsplat.gaussians.law_normal_lobes import NormalLobes
from sarsplat.gaussians.law_polarimetric import Polarimetric
from sarsplat.gaussians.scattering import Scattering, register_scattering, scattering_named
from sarsplat.names import SCATTERINGS

__all__ = [
    "MAX_OPTICAL_DEPTH",
    "MIN_SCALE",
    "SCATTERINGS",
    "Gaussians",
    "Ground",
    "Harmonics",
    "NormalLobes",
    "Polarimetric",
    "Scattering",
    "register_scattering",
    "scattering_named",
]
