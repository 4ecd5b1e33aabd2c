from .buildings import BUILDINGS, Building, BuildingProfile, Gamma0, building_profile
from .mechanisms import Mechanisms
from .meshes import load_mesh
from .protocols import mstar_grid, mstar_views, paper_grid, paper_views
from .raycast import simulate_raycast
from .scattering import ScatteringLaw, add_speckle
from .simulate_stack import simulate_stack
from .splat_truth import law_by_ground, law_scattering, surface_gaussians
from .targets import TARGETS, VEHICLES, target_mesh
from .village import village

__all__ = [
    "BUILDINGS",
    "TARGETS",
    "VEHICLES",
    "Building",
    "BuildingProfile",
    "Gamma0",
    "Mechanisms",
    "ScatteringLaw",
    "add_speckle",
    "building_profile",
    "law_by_ground",
    "law_scattering",
    "load_mesh",
    "mstar_grid",
    "mstar_views",
    "paper_grid",
    "paper_views",
    "simulate_raycast",
    "simulate_stack",
    "surface_gaussians",
    "target_mesh",
    "village",
]
