"""Rendering of large scenes by tiles."""

from sarsplat.tiles.plan import at_once
from sarsplat.tiles.render import render_tiled
from sarsplat.tiles.tile_cache import tiles_kept_in

__all__ = ["at_once", "render_tiled", "tiles_kept_in"]
