"""Meshes from three sides, shaded: the reconstruction beside the true surface where it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sarsplat.colours import POWER
from sarsplat.report.figure import Block
from sarsplat.report.sides import Raster

if TYPE_CHECKING:
    import trimesh

_LIGHT = np.array([0.4, -0.5, 0.77])
_AMBIENT = 0.25
_PIXELS = 300  # along the longest side
_SAMPLES_PER_PIXEL, _MOST_SAMPLES = 8, 2_000_000  # a pixel without any is a hole
_MARGIN = 0.03  # of the longest side


def mesh_boards(reconstructed: trimesh.Trimesh, truth: trimesh.Trimesh | None) -> tuple[Block, ...]:
    """Shaded meshes from the side, the front and the top.

    Parameters
    ----------
    reconstructed : trimesh.Trimesh
        At least one face, m.
    truth : trimesh.Trimesh or None
        The true surface, m; drawn before it from the same sides.
    """
    meshes = {f"reconstruction, {len(reconstructed.faces):,} triangles": reconstructed}
    if truth is not None:
        meshes = {"true surface": truth, **meshes}
    bounds = np.stack([mesh.bounds for mesh in meshes.values()])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    margin = _MARGIN * (high - low).max()
    raster = Raster.around(low - margin, high + margin, _PIXELS)
    return tuple(_board(raster, name, mesh) for name, mesh in meshes.items())


def _board(raster: Raster, title: str, mesh: trimesh.Trimesh) -> Block:
    from trimesh.sample import sample_surface

    count = min(int(_SAMPLES_PER_PIXEL * mesh.area / raster.pixel_m**2) + 1, _MOST_SAMPLES)
    places, faces = sample_surface(mesh, count, seed=0)
    lit = _AMBIENT + (1 - _AMBIENT) * np.abs(mesh.face_normals[faces] @ (_LIGHT / np.linalg.norm(_LIGHT)))
    return raster.board(title, np.asarray(places), lit, (0.0, 1.0), POWER)
