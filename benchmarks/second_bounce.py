"""The second bounce by way of the ground: the renderer's against the ray caster's, from twelve directions; its cost.

`python benchmarks/second_bounce.py [box] [t72] [building-a] … [cost]`; a T-72 takes some minutes. Levels are rendered
over traced power; costs are those of ground and bounce over those of ground alone.
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
import torch
from clock import in_turn, ratio, spread
from recipes import halfway

from sarsplat import Ground, ImageGrid, RayGrid, ScatteringLaw, View, mstar_grid, paper_grid, render, target_mesh
from sarsplat.renderer import GroundBounce
from sarsplat.scenes import law_by_ground, law_scattering, paper_views, surface_gaussians
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


def cost() -> None:
    """Print what four views of a training's Gaussians, halfway through, take with and without it."""
    views, grid = [view for view, split in paper_views() if split == "train"][::6], paper_grid()
    gaussians = halfway().target(3)
    leaves = [tensor.detach().requires_grad_() for tensor in gaussians.tensors().values()]
    scene = gaussians.with_tensors(**dict(zip(gaussians.tensors(), leaves, strict=True)))
    ground = Ground(torch.tensor(0.05))
    weights = torch.randn(len(views), 1, grid.rows, grid.columns, generator=torch.Generator().manual_seed(0))

    def forward(*echoes: GroundBounce) -> None:
        with torch.no_grad():
            render(scene, views, grid, ground=ground, echoes=echoes)

    def backward(*echoes: GroundBounce) -> None:
        images = render(scene, views, grid, ground=ground, echoes=echoes).images
        torch.autograd.grad((images * weights).sum(), leaves)

    bounce = GroundBounce(ground, torch.tensor(0.5))
    for name, program in {"forward": forward, "and backward": backward}.items():
        times = in_turn({"with": partial(program, bounce), "without": program}, 40)
        quotient = ratio(times["with"], times["without"])
        print(
            f"{name}: {1e3 * spread(times['without'])['median']:.1f} ms, with the bounce {quotient['median']:.2f} times"
        )


if __name__ == "__main__":
    for target in sys.argv[1:] or ["box", "building-a", "t72", "cost"]:
        cost() if target == "cost" else compare(target)
