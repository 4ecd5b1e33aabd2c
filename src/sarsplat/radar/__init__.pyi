# ruff: isort: skip_file
from .iso_range import Pixel as Pixel, contributions as contributions, iso_range_line as iso_range_line
from .maps import RadarMaps as RadarMaps, radar_maps as radar_maps
from .surface import Surface as Surface, surface_of_mesh as surface_of_mesh, surface_of_run as surface_of_run
