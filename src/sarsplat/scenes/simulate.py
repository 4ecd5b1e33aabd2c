"""Simulated images of a mesh from many views, by ray casting or splatting, and the record of how they were made."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Real

from sarsplat.arguments import checks_arguments
from sarsplat.extras import Trimesh
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.responses import GAUSSIAN
from sarsplat.names import Simulator
from sarsplat.renderer import GroundBounce, render
from sarsplat.scenes._parallel import in_order
from sarsplat.scenes._second_bounce import BY_GROUND
from sarsplat.scenes.placement import warn_below_ground
from sarsplat.scenes.raycast import RayCaster, default_ray_spacing
from sarsplat.scenes.scattering import ScatteringLaw, check_ground, check_reflectivity, raise_first
from sarsplat.scenes.splat_truth import law_by_ground, law_scattering, surface_gaussians

# Protocol R: nodes of the ray caster, and Gaussians and rays of the splat truth, per pixel spacing.
_OVERSAMPLE = 9
_PIECES_PER_PIXEL, _RAYS_PER_PIXEL = 3.0, 15.0


@checks_arguments
def simulate_images(
    mesh: Trimesh,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    source: Simulator = "raycast",
    law: ScatteringLaw | None = None,
    reflectivity: Real[np.ndarray, " faces"] | Sequence[float] | None = None,
    ground_gamma0: float | None = None,
    terrain: Terrain | None = None,
    bounces: int = 1,
    ground_reflectivity: float | None = None,
    ray_spacing: float | None = None,
    progress: Callable[[float], object] | None = None,
    power_by_echo: dict[str, float] | None = None,
) -> Float32[np.ndarray, "v {grid.rows} {grid.columns}"]:
    """Simulate SAR images of a mesh from every view, without speckle (`add_speckle`).

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Target, m.
    views, grid
        V views, and the pixels of each image.
    source : {"raycast", "splat"}
        Ray casting of the mesh (R-ray: shares nothing with the renderer), or the renderer with Gaussians on the surface
        (R-self, as in the paper).
    law : ScatteringLaw, optional
        γ⁰ of the surface against incidence angle; 0.1 + 0.9 cos² i unless given.
    reflectivity, ground_gamma0, terrain, bounces, ground_reflectivity
        As for `simulate_raycast`. Splatting has second bounces between flat ground and the mesh only.
    ray_spacing : float, optional
        Spacing of the rays in ray casting, m; `default_ray_spacing` unless given.
    progress : callable, optional
        Called with the number of finished images after each. Ray casting of several views at once also calls it several
        times a second with fractions.
    power_by_echo : dict, optional
        With second bounces, filled with the share of each kind of echo in the power of all images.

    Returns
    -------
    numpy.ndarray, float32 [V, rows, columns]
        β⁰, linear power.

    Raises
    ------
    SarsplatError
        If the source is unknown, or the mesh or a setting is invalid.

    Warns
    -----
    SarsplatWarning
        If a good part of the mesh is below the ground.
    """
    law = law or ScatteringLaw()
    reflectivity = check_reflectivity(reflectivity, len(mesh.faces))
    check_ground(ground_gamma0, terrain, bounces, ground_reflectivity)
    warn_below_ground(mesh, grid, ground_gamma0, terrain)
    splat = source == "splat"
    raise_first(
        (splat and ray_spacing is not None, f"`ray_spacing` is {ray_spacing}, but it is for ray casting; leave it out"),
        (splat and grid.response != GAUSSIAN, f"response is {grid.response}, not Gaussian; choose `source='raycast'`"),
        (
            splat and bounces == 2 and not ground_reflectivity,
            "the renderer's second bounces need ground that reflects; give `ground_reflectivity` or `source='raycast'`",
        ),
    )
    images: Iterator[Float[np.ndarray, "{grid.rows} {grid.columns}"]]
    powers: dict[View, dict[str, float]] = {}
    if not splat:
        spacing = default_ray_spacing(mesh, grid) if ray_spacing is None else ray_spacing
        ground: dict[str, Any] = {"ground_gamma0": ground_gamma0, "terrain": terrain}
        ground |= {"bounces": bounces, "ground_reflectivity": ground_reflectivity}
        rays: dict[str, Any] = {"ray_spacing": spacing, "oversample": _OVERSAMPLE}
        caster = RayCaster(mesh, grid, law, reflectivity=reflectivity, **ground, **rays)
        images, powers = in_order(caster.image, views, progress), caster.power_by_echo
    else:
        images = _splat(mesh, views, grid, law, reflectivity, ground_gamma0, terrain, ground_reflectivity, powers)
    stack = np.empty((len(views), grid.rows, grid.columns), dtype=np.float32)
    for index, image in enumerate(images):
        stack[index] = image
        if progress is not None:
            progress(index + 1)
    if power_by_echo is not None and powers:
        of_views = [powers[view] for view in views]
        total = sum(sum(one.values()) for one in of_views) or 1.0
        power_by_echo |= {kind: sum(one[kind] for one in of_views) / total for kind in of_views[0]}
    return stack


def simulation_record(
    *,
    source: Simulator,
    law: ScatteringLaw,
    ground_gamma0: float | None,
    ray_spacing: float | None,
    seed: int,
    bounces: int = 1,
    ground_reflectivity: float | None = None,
    power_by_echo: dict[str, float] | None = None,
    ray_error_db: float | None = None,
) -> dict[str, Any]:
    """Return the arguments of `simulate_images` and the seed of all that is random, as JSON for a dataset's `source`.

    `ray_error_db` is the result of `ray_error_db`, and `power_by_echo` that of `simulate_images`. Bounces are left out
    unless there are second ones.
    """
    sampling: dict[str, dict[str, Any]] = {
        "raycast": {"ray_spacing_m": ray_spacing, "ray_error_db": ray_error_db, "nodes_per_pixel": _OVERSAMPLE},
        "splat": {"surface_pieces_per_pixel": _PIECES_PER_PIXEL, "rays_per_pixel": _RAYS_PER_PIXEL},
    }
    second = {"bounces": bounces, "ground_reflectivity": ground_reflectivity, "power_by_echo": power_by_echo}
    return {
        "kind": source,
        "law": law.as_dict(),
        "law_formula": "gamma0(i) = floor + lobe*|cos(i)|^exponent; i = angle between facet normal and radar",
        "ground_gamma0": ground_gamma0,
        "seed": seed,
        **sampling[source],
        **(second if bounces == 2 else {}),
    }


def _splat(
    mesh: Trimesh,
    views: Sequence[View],
    grid: ImageGrid,
    law: ScatteringLaw,
    reflectivity: Float64[np.ndarray, " faces"],
    ground_gamma0: float | None,
    terrain: Terrain | None,
    ground_reflectivity: float | None,
    powers: dict[View, dict[str, float]],
) -> Iterator[Float[np.ndarray, "{grid.rows} {grid.columns}"]]:
    pixel = min(grid.spacing_m)
    gaussians, faces = surface_gaussians(mesh, pixel / _PIECES_PER_PIXEL)
    height_m = 0.0 if terrain is None else terrain
    ground = None if ground_gamma0 is None else Ground(torch.tensor(ground_gamma0), height_m=height_m)
    rays = RayGrid.for_image(grid, _RAYS_PER_PIXEL)
    for view in views:
        face_gamma0 = reflectivity * law_scattering(mesh.face_normals, [view], law)
        gamma0 = torch.from_numpy(face_gamma0[:, faces, None]).float()
        echoes = []
        if ground is not None and ground_reflectivity:
            to_ground = reflectivity * law_by_ground(mesh.face_normals, [view], law)
            amplitudes = torch.from_numpy(to_ground[:, faces]).float()
            echoes.append(GroundBounce(ground, torch.tensor(ground_reflectivity), amplitudes))
        with torch.no_grad():
            rendering = render(gaussians, [view], grid, rays=rays, amplitudes=gamma0, ground=ground, echoes=echoes)
        if echoes:
            sums = dict(zip(("ground", BY_GROUND), (float(echo.sum()) for echo in rendering.echoes), strict=True))
            powers[view] = {"target": float(rendering.images.sum()) - sum(sums.values()), **sums}
        yield rendering.channel(0)[0].numpy()
