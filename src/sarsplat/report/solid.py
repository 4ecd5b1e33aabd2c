"""Meshes from three sides, shaded: the reconstruction beside the true surface where it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from sarsplat.report.canvas import to_png
from sarsplat.report.sides import SIDES, drawing_boards

if TYPE_CHECKING:
    import trimesh

_LIGHT = np.array([0.4, -0.5, 0.77])
_AMBIENT = 0.25
_PIXELS = 240  # along the longest side
_SAMPLES_PER_PIXEL, _MOST_SAMPLES = 12, 4_000_000  # a pixel without any is a hole
_MARGIN = 0.03  # of the longest side


def meshes_figure(reconstructed: trimesh.Trimesh, truth: trimesh.Trimesh | None) -> bytes:
    """Shaded meshes from the side, the front and the top, on equal axes in metres, as PNG.

    Parameters
    ----------
    reconstructed : trimesh.Trimesh
        At least one face, m.
    truth : trimesh.Trimesh or None
        The true surface, m; drawn beside it from the same sides.
    """
    blocks = [(f"reconstruction, {len(reconstructed.faces):,} triangles", reconstructed)]
    if truth is not None:
        blocks.insert(0, ("true surface", truth))
    bounds = np.stack([mesh.bounds for _, mesh in blocks])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    low, high = low - _MARGIN * (high - low).max(), high + _MARGIN * (high - low).max()
    figure, boards = drawing_boards([name for name, _ in blocks], low, high)
    for board, (_, mesh) in zip(boards, blocks, strict=True):
        for axes, side, picture in zip(board.sides, SIDES, _shaded(mesh, low, high), strict=True):
            extent = (low[side.across], high[side.across], low[side.up], high[side.up])
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=extent, origin="lower")
    return to_png(figure)


def _shaded(
    mesh: trimesh.Trimesh, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> list[Float[np.ndarray, "rows columns"]]:
    """Brightness from 0 to 1 as seen from each side, NaN where nothing is; row 0 is the lowest."""
    from trimesh.sample import sample_surface

    pixel = (high - low).max() / _PIXELS
    places, faces = sample_surface(mesh, min(int(_SAMPLES_PER_PIXEL * mesh.area / pixel**2) + 1, _MOST_SAMPLES), seed=0)
    normals = mesh.face_normals[faces]
    lit = _AMBIENT + (1 - _AMBIENT) * np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
    pictures = []
    for side in SIDES:
        shape = [int(np.ceil((high - low)[axis] / pixel)) for axis in (side.up, side.across)]
        row, column = (
            np.minimum((places[:, k] - low[k]) // pixel, n - 1).astype(int)
            for k, n in zip((side.up, side.across), shape)
        )
        nearest_last = np.argsort(side.sign * places[:, side.towards], kind="stable")
        picture = np.full(shape, np.nan)
        picture[row[nearest_last], column[nearest_last]] = lit[nearest_last]
        pictures.append(picture)
    return pictures
