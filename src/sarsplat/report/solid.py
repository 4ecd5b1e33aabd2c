"""Meshes from three sides, shaded: the reconstruction beside the true surface where it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from sarsplat.report.canvas import INK, MUTED, dress, new_figure, to_png

if TYPE_CHECKING:
    import trimesh

# Name, horizontal and vertical axis, axis that points at the viewer, its sign: as the points are shown.
_SIDES = (("side", 0, 2, 1, -1), ("front", 1, 2, 0, 1), ("top", 0, 1, 2, 1))
_LIGHT = np.array([0.4, -0.5, 0.77])
_AMBIENT = 0.25
_PIXELS = 240  # along the longest side
_SAMPLES = 600_000  # several on every pixel
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
    size = high - low
    scale = 5.4 / (size[0] + size[1])  # inches per metre
    height = (size[2] + size[1]) * scale + 1.2
    figure = new_figure(len(blocks) * 6.4, height)
    for block, (name, mesh) in zip(figure.subfigures(1, len(blocks), squeeze=False)[0], blocks, strict=True):
        block.set_facecolor("none")
        grid = block.add_gridspec(
            *(2, 2),
            width_ratios=(size[0], size[1]),
            height_ratios=(size[2], size[1]),
            left=0.09,
            right=0.985,
            top=1 - 0.5 / height,
            bottom=0.34 / height,
            wspace=0.12,
            hspace=0.24,
        )
        pictures = _shaded(mesh, low, high)
        for (side, across, up, _, _), place, picture in zip(
            _SIDES, (grid[0, 0], grid[0, 1], grid[1, 0]), pictures, strict=True
        ):
            axes = block.add_subplot(place)
            extent = (low[across], high[across], low[up], high[up])
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=extent, origin="lower")
            dress(axes)
            axes.set_title(f"{side}, m", loc="left", size=9, color=MUTED, pad=3)
        block.text(0.09, 1 - 0.24 / height, name, color=INK, size=11, weight="bold")
    return to_png(figure)


def _shaded(
    mesh: trimesh.Trimesh, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> list[Float[np.ndarray, "rows columns"]]:
    """Brightness from 0 to 1 as seen from each side, NaN where nothing is; row 0 is the lowest."""
    from trimesh.sample import sample_surface

    places, faces = sample_surface(mesh, _SAMPLES, seed=0)
    normals = mesh.face_normals[faces]
    lit = _AMBIENT + (1 - _AMBIENT) * np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
    pixel = (high - low).max() / _PIXELS
    pictures = []
    for _, across, up, towards, sign in _SIDES:
        shape = [int(np.ceil((high - low)[axis] / pixel)) for axis in (up, across)]
        row, column = (
            np.minimum((places[:, k] - low[k]) // pixel, n - 1).astype(int) for k, n in zip((up, across), shape)
        )
        nearest_last = np.argsort(sign * places[:, towards], kind="stable")
        picture = np.full(shape, np.nan)
        picture[row[nearest_last], column[nearest_last]] = lit[nearest_last]
        pictures.append(picture)
    return pictures
