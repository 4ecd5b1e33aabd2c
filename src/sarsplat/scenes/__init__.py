"""Truth for experiments, independent of the renderer: targets, the ray-cast simulator, speckle, protocols."""

from sarsplat.scenes.building_profile import BuildingProfile, building_profile
from sarsplat.scenes.buildings import BUILDINGS, Building, Gamma0
from sarsplat.scenes.mechanisms import Mechanisms
from sarsplat.scenes.meshes import load_mesh
from sarsplat.scenes.protocols import mstar_grid, mstar_views, paper_grid, paper_views
from sarsplat.scenes.raycast import simulate_raycast
from sarsplat.scenes.scattering import ScatteringLaw, add_speckle
from sarsplat.scenes.simulate_stack import simulate_stack
from sarsplat.scenes.splat_truth import law_scattering, surface_gaussians
from sarsplat.scenes.targets import TARGETS, VEHICLES, target_mesh

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
]
