"""Echoes: returns other than the direct one of the Gaussians, each a file of this folder."""

from sarsplat.renderer.echoes.echo import Echo, RayEnds, Sighting
from sarsplat.renderer.echoes.ground import GroundEcho

__all__ = ["Echo", "GroundEcho", "RayEnds", "Sighting"]
