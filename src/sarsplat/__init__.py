"""Render SAR images from 3D Gaussians, and reconstruct 3D targets from SAR images.

Everything public is here by name and loaded when first used: importing the package, and the command line's help, need
no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sarsplat.data import (
        Dataset,
        DatasetEntry,
        PhoenixChip,
        SarImage,
        import_mstar,
        read_dataset,
        read_gaussians_ply,
        read_phoenix,
        read_points_ply,
        write_dataset,
        write_gaussians_ply,
        write_points_ply,
    )
    from sarsplat.errors import SarsplatError, SarsplatWarning
    from sarsplat.evaluation import evaluate_run, point_metrics, visible_surface
    from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, Harmonics, NormalLobes, Scattering
    from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
    from sarsplat.reconstruction import PRESETS, Config, Run, Trainer, extract_points, preset, reconstruct
    from sarsplat.renderer import (
        Attenuation,
        Footprints,
        Projection,
        RayMap,
        Rendering,
        attenuate,
        project,
        render,
        splat,
    )
    from sarsplat.report import write_report
    from sarsplat.scenes import (
        ScatteringLaw,
        add_speckle,
        load_mesh,
        mstar_grid,
        mstar_views,
        paper_grid,
        paper_views,
        simulate_raycast,
        target_mesh,
    )
    from sarsplat.scenes.simulate import simulate_images

__version__ = "0.1.0"

_HOME = {
    "errors": ("SarsplatError", "SarsplatWarning"),
    "geometry": ("ImageGrid", "RayGrid", "View", "radar_frame"),
    "gaussians": ("MAX_OPTICAL_DEPTH", "MIN_SCALE", "Gaussians", "Harmonics", "NormalLobes", "Scattering"),
    "renderer": (
        *("Attenuation", "Footprints", "Projection", "RayMap", "Rendering"),
        *("attenuate", "project", "render", "splat"),
    ),
    "scenes": (
        *("ScatteringLaw", "add_speckle", "load_mesh", "mstar_grid", "mstar_views", "paper_grid", "paper_views"),
        *("simulate_raycast", "target_mesh"),
    ),
    "scenes.simulate": ("simulate_images",),
    "data": (
        *("Dataset", "DatasetEntry", "PhoenixChip", "SarImage", "import_mstar", "read_dataset", "read_gaussians_ply"),
        *("read_phoenix", "read_points_ply", "write_dataset", "write_gaussians_ply", "write_points_ply"),
    ),
    "reconstruction": ("PRESETS", "Config", "Run", "Trainer", "extract_points", "preset", "reconstruct"),
    "evaluation": ("evaluate_run", "point_metrics", "visible_surface"),
    "report": ("write_report",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "MAX_OPTICAL_DEPTH",
    "MIN_SCALE",
    "PRESETS",
    "Attenuation",
    "Config",
    "Dataset",
    "DatasetEntry",
    "Footprints",
    "Gaussians",
    "Harmonics",
    "ImageGrid",
    "NormalLobes",
    "PhoenixChip",
    "Projection",
    "RayGrid",
    "RayMap",
    "Rendering",
    "Run",
    "SarImage",
    "SarsplatError",
    "SarsplatWarning",
    "Scattering",
    "ScatteringLaw",
    "Trainer",
    "View",
    "add_speckle",
    "attenuate",
    "evaluate_run",
    "extract_points",
    "import_mstar",
    "load_mesh",
    "mstar_grid",
    "mstar_views",
    "paper_grid",
    "paper_views",
    "point_metrics",
    "preset",
    "project",
    "radar_frame",
    "read_dataset",
    "read_gaussians_ply",
    "read_phoenix",
    "read_points_ply",
    "reconstruct",
    "render",
    "simulate_images",
    "simulate_raycast",
    "splat",
    "target_mesh",
    "visible_surface",
    "write_dataset",
    "write_gaussians_ply",
    "write_points_ply",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'sarsplat' has no attribute {name!r}")
    value = getattr(import_module(f"sarsplat.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
