"""Scenes too large to be rendered at once: their images by tiles."""

from __future__ import annotations

from sarsplat.tiles.kept import tiles_kept_in
from sarsplat.tiles.plan import at_once
from sarsplat.tiles.render import render_tiled

__all__ = ["at_once", "render_tiled", "tiles_kept_in"]
