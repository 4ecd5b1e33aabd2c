"""What the radar sees of a target, and why a pixel shows what it shows. What needs torch is loaded when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sarsplat.radar.iso_range import Pixel, contributions, iso_range_line
    from sarsplat.radar.maps import RadarMaps, radar_maps
    from sarsplat.radar.surface import Surface, surface_of_mesh, surface_of_run

_MODULE_OF = {
    "Pixel": "iso_range",
    "RadarMaps": "maps",
    "Surface": "surface",
    "contributions": "iso_range",
    "iso_range_line": "iso_range",
    "radar_maps": "maps",
    "surface_of_mesh": "surface",
    "surface_of_run": "surface",
}

__all__ = [
    "Pixel",
    "RadarMaps",
    "Surface",
    "contributions",
    "iso_range_line",
    "radar_maps",
    "surface_of_mesh",
    "surface_of_run",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
