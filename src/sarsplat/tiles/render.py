"""`render_tiled`: one view of a scene that is too large to be rendered at once."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.progress import stage
from sarsplat.renderer.ground import above
from sarsplat.tiles.image import tile_image
from sarsplat.tiles.kept import Kept
from sarsplat.tiles.plan import Plan
from sarsplat.tiles.reach import Reach

USUAL_GIB = 0.5
"""What a tile takes unless told otherwise: beyond, it is no faster."""


@checks_arguments
def render_tiled(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, " 2"] | None = None,
    ground: Ground | None = None,
    memory_gib: float = USUAL_GIB,
    keep: str | Path | None = None,
) -> Float[Tensor, "c {grid.rows} {grid.columns}"]:
    """Render one view by tiles, in memory that does not grow with the image; no gradients.

    The image is halved until each part fits, together with the Gaussians that reach it and those that shade these. All
    tiles have the rays of one lattice and the footprints of one projection, so that no seams are seen.

    Parameters
    ----------
    gaussians, grid, rays, ground
        As at `sarsplat.render`.
    view : View
        From where.
    shift : Tensor [2], optional
        Displacement (azimuth, range) of the image, m.
    memory_gib : float
        What a tile may take, GiB. Beyond it, rendering takes 32 bytes for each Gaussian, and the image.
    keep : str or Path, optional
        A folder for finished tiles, made if it is not there. A rendering of the same goes on from those that it finds;
        whoever gave the folder removes it.

    Returns
    -------
    Tensor [C, rows, columns]
        The image on the CPU, β⁰, linear power, where a channel is power; the same bits whether it was resumed or not.

    Raises
    ------
    SarsplatError
        If `render` would refuse the scene, a few pixels alone do not fit into the memory, or a tile cannot be kept.
    """
    if not 0 < memory_gib < float("inf"):
        raise SarsplatError(f"memory_gib {memory_gib} must be positive and finite, such as {USUAL_GIB}")
    rays = rays or RayGrid.for_image(grid)
    with torch.no_grad():
        scene = gaussians if ground is None else above(gaussians, ground)
        displaced = None if shift is None else shift[None]
        reach = Reach.of(scene, view, grid, rays, displaced)
        plan = Plan(reach, view, grid, rays, ground, gaussians.tensors()["scattering"].shape[1], memory_gib * 2**30)
        kept = None if keep is None else Kept(Path(keep), gaussians, view, grid, rays, shift, ground, memory_gib)
        image = torch.empty(len(gaussians.scattering.channels), grid.rows, grid.columns, dtype=gaussians.means.dtype)
        with stage("tiles, in pixels", grid.rows * grid.columns) as reporter:
            for tile in plan.tiles(torch.arange(len(scene), device=scene.means.device)):

                def make() -> Float[Tensor, "c rows columns"]:
                    return tile_image(scene, view, grid, tile, rays, displaced, ground).cpu()

                image[:, tile.rows, tile.columns] = make() if kept is None else kept.image(tile, make)
                reporter.advance(tile.grid.rows * tile.grid.columns)
        return image
