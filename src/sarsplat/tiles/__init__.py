"""Scenes too large to be rendered at once: their images by tiles."""

from __future__ import annotations

from sarsplat.tiles.render import render_tiled

__all__ = ["render_tiled"]
