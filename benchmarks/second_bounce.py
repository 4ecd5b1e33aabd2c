"""The second bounce by way of the ground: the renderer's against the ray caster's, from twelve directions.

`python benchmarks/second_bounce.py [box] [t72] [building-a] …`; a T-72 takes some minutes. Levels are rendered over
traced power.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from sarsplat import Ground, ImageGrid, RayGrid, ScatteringLaw, View, mstar_grid, paper_grid, render, target_mesh
from sarsplat.renderer import GroundBounce
from sarsplat.scenes import law_by_ground, law_scattering, surface_gaussians
from sarsplat.scenes._second_bounce import BY_GROUND
from sarsplat.scenes._shapes import box
from sarsplat.scenes.raycast import RayCaster, default_ray_spacing

LAW = ScatteringLaw(0.1, 0.9, 8.0)
VIEWS = [View(30.0 * k + 7.0, (17.0, 30.0, 45.0, 60.0)[k % 4]) for k in range(12)]
PIECES_PER_PIXEL, RAYS_PER_PIXEL = 6.0, 30.0


def compare(name: str) -> None:
    """Print a row for each direction."""
    mesh = box((-2, 2), (-1, 1), (0, 1.5)) if name == "box" else target_mesh(name)
    grid: ImageGrid = paper_grid() if name.startswith("building") else mstar_grid()
    caster = RayCaster(
        mesh,
        grid,
        LAW,
        reflectivity=None,
        ground_gamma0=0.0,
        ray_spacing=default_ray_spacing(mesh, grid),
        bounces=2,
        ground_reflectivity=1.0,
    )
    gaussians, faces = surface_gaussians(mesh, min(grid.spacing_m) / PIECES_PER_PIXEL)
    rays, ground = RayGrid.for_image(grid, RAYS_PER_PIXEL), Ground(torch.tensor(0.0))
    for view in VIEWS:
        traced = caster.second_bounces(view)[BY_GROUND]
        direct, sent_on = (
            torch.from_numpy(law(mesh.face_normals, [view], LAW)[:, faces]).float()
            for law in (law_scattering, law_by_ground)
        )
        bounce = GroundBounce(ground, torch.tensor(1.0), sent_on)
        with torch.no_grad():
            rendering = render(
                gaussians, [view], grid, rays=rays, amplitudes=direct[..., None], ground=ground, echoes=[bounce]
            )
        splatted = rendering.echoes[1][0].double().numpy()
        alike = np.corrcoef(traced.ravel(), splatted.ravel())[0, 1]
        where = f"{name:12} azimuth {view.azimuth_deg:3.0f}° grazing {view.grazing_deg:2.0f}°"
        print(f"{where}: level {splatted.sum() / traced.sum():.4f}, correlation {alike:.5f}", flush=True)


if __name__ == "__main__":
    for target in sys.argv[1:] or ["box", "building-a", "t72"]:
        compare(target)
