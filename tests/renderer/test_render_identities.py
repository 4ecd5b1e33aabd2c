"""What every renderer must satisfy, whatever its arithmetic (docs/concepts/image-model.md, identities)."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from compared import relative
from named_scenes import MATRIX, VIEWS, cloud, facing, with_scales

from sarsplat import Gaussians, Harmonics, ImageGrid, RayGrid, View, radar_frame, render
from sarsplat.gaussians.gaussians import covariance, rotation_matrix
from sarsplat.gaussians.law_harmonics import harmonic_basis
from sarsplat.renderer.engines import cpu

ENGINES = [f"cpu-{name}" for name in cpu.instruction_sets()] + ["reference"]
DTYPE = {name: torch.float64 if name == "reference" else torch.float32 for name in ENGINES}
EXACT = {name: 1e-11 if name == "reference" else 2e-5 for name in ENGINES}

pytestmark = pytest.mark.parametrize("engine", ENGINES)


def sheet(origin, along, across, counts, gamma0: float, spacing: float) -> Gaussians:
    """A flat, opaque, rectangular sheet of discs from a corner (§6): s = Δ/2, pitch 1.6 s, mean optical depth 8."""
    s = spacing / 2
    pitch = 1.6 * s
    kappa = 8 * pitch**2 / (2 * math.pi * s**2)
    i, j = (axis.ravel() + 0.5 for axis in np.meshgrid(np.arange(counts[0]), np.arange(counts[1])))
    along, across = np.asarray(along, float), np.asarray(across, float)
    points = np.asarray(origin, float) + pitch * (i[:, None] * along + j[:, None] * across)
    n = len(points)
    width = s * (abs(along) + abs(across)) + 1e-3 * (1 - abs(along) - abs(across))  # the sheet lies along two axes
    return Gaussians(
        torch.tensor(points),
        torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(n, 4),
        torch.tensor(width).expand(n, 3),
        torch.full((n,), kappa, dtype=torch.float64),
        Harmonics(torch.full((n, 1), math.log(math.expm1(gamma0)) * 2 * math.sqrt(math.pi), dtype=torch.float64)),
    )


def one(kappa: float = 1.0, scales: tuple[float, float, float] = (0.4, 0.3, 0.2), mean=(0.1, 0.2, 0.3)) -> Gaussians:
    return Gaussians(
        torch.tensor([mean], dtype=torch.float64),
        torch.tensor([[0.9, 0.3, -0.2, 0.1]], dtype=torch.float64),
        torch.tensor([scales], dtype=torch.float64),
        torch.tensor([kappa], dtype=torch.float64),
        Harmonics(torch.tensor([[0.7]], dtype=torch.float64)),
    )


# ---- 1. opaque surfaces: a level that depends on the grazing angle alone ---------------------------------------------
GRID = ImageGrid(12, 8, spacing_m=(0.5, 0.5), resolution_m=(0.75, 0.75))
RAYS = RayGrid.for_image(GRID, per_pixel=4)
LOOK = 0.0  # the radar stands at +x


@pytest.mark.parametrize("grazing", [30.0, 45.0, 60.0])
@pytest.mark.parametrize("upright", [False, True])
def test_opaque_ground_and_walls(engine, upright, grazing):
    theta, r = math.radians(grazing), GRID.range_m
    if upright:  # height z comes in at range −z sin θ: the wall's top is nearest
        surface = sheet((0.0, -3.2, 0.0), (0, 1, 0), (0, 0, 1), (16, 20), gamma0=0.3, spacing=0.5)
        expected, lit = 0.3 / math.tan(theta), (r < -1.0) & (r > 1.0 - 8.0 * math.sin(theta))
    else:
        surface = sheet((-4.0, -3.2, 0.0), (1, 0, 0), (0, 1, 0), (20, 16), gamma0=0.3, spacing=0.5)
        expected, lit = 0.3 * math.tan(theta), abs(r) < 4.0 * math.cos(theta) - 1.5  # away from the sheet's ends
    image = render(surface.to(DTYPE[engine]), [View(LOOK, grazing)], GRID, rays=RAYS, engine=engine).channel(0)[0]
    assert lit.sum() >= 2
    level = image[torch.from_numpy(lit)].numpy()
    assert level.mean() == pytest.approx(expected, rel=0.005)
    assert level == pytest.approx(expected, rel=0.02)


def test_layover_adds_and_the_shadow_is_as_long_as_geometry_says(engine):
    tan, cos = math.tan(math.radians(50.0)), math.cos(math.radians(50.0))
    height, reach = 1.92, 5.2  # m
    grid = ImageGrid(40, 8, spacing_m=(0.2, 0.2), resolution_m=(0.25, 0.25))
    ground = sheet((-reach, -1.6, 0.0), (1, 0, 0), (0, 1, 0), (65, 20), gamma0=0.3, spacing=0.2)
    wall = sheet((0.0, -1.6, 0.0), (0, 1, 0), (0, 0, 1), (20, 12), gamma0=0.3, spacing=0.2)
    rendering = render(Gaussians.cat([ground, wall]).to(DTYPE[engine]), [View(LOOK, 50.0)], grid, engine=engine)
    level = rendering.channel(0)[0, :, 3:5].mean(1).numpy() / 0.3
    g = grid.range_m / cos  # ground range from the wall's foot, away from the radar
    assert level[(g > -height * tan + 0.6) & (g < -0.6)] == pytest.approx(tan + 1 / tan, rel=0.02)
    assert level[(g < -height * tan - 0.6) & (g > 0.6 - reach)] == pytest.approx(tan, rel=0.02)
    assert level[(g > height / tan + 0.6) & (g < reach - 0.6)] == pytest.approx(tan, rel=0.02)
    edge = g[np.flatnonzero((g > 0.6) & (level > tan / 2))[0]]  # where the ground behind the wall is lit again
    assert edge == pytest.approx(height / tan, abs=grid.spacing_m[1] / cos)
    assert level[(g > 0.5) & (g < height / tan - 0.5)] == pytest.approx(0.0, abs=0.02 * tan)


# ---- 2. one Gaussian -------------------------------------------------------------------------------------------------
def test_the_image_holds_the_cross_section(engine):
    grid = ImageGrid(40, 44, spacing_m=(0.2, 0.25), resolution_m=(0.3, 0.4))  # ρ ≥ 1.5 Δ
    rendering = render(one().to(DTYPE[engine]), VIEWS, grid, engine=engine)
    total = rendering.channel(0).sum((1, 2)) * 0.2 * 0.25
    assert total.numpy() == pytest.approx(rendering.cross_sections[:, 0, 0].numpy(), rel=2e-3)


def test_moving_by_whole_pixels_moves_the_image(engine):
    grid = ImageGrid(40, 44, spacing_m=(0.2, 0.25), resolution_m=(0.3, 0.3))
    rays = RayGrid((0.1, 0.05))
    scene = cloud(20, 3, scale=0.15).to(DTYPE[engine])
    step = facing(VIEWS[0], torch.tensor([[2 * 0.2, 3 * 0.05, 3 * 0.25]])).to(DTYPE[engine])
    still = render(scene, VIEWS[:1], grid, rays=rays, engine=engine)
    moved = render(replace(scene, means=scene.means + step), VIEWS[:1], grid, rays=rays, engine=engine)
    # float32 moves the Gaussians by up to 1e-7 m against the rays; a pair on a cut may change sides
    assert relative(moved.cross_sections, still.cross_sections) <= 1e-5
    assert relative(moved.images[..., 3:, 2:], still.images[..., :-3, :-2]) <= 1e-5
    shifted = render(
        scene, VIEWS[:1], grid, rays=rays, engine=engine, shift=torch.tensor([[0.4, 0.75]], dtype=DTYPE[engine])
    )
    assert relative(shifted.images[..., 3:, 2:], still.images[..., :-3, :-2]) <= 1e-5


def test_cross_section_of_a_thin_gaussian(engine):
    kappa = 1e-2
    scene = one(kappa)
    rendering = render(scene.to(DTYPE[engine]), VIEWS, GRID, rays=RayGrid((0.02, 0.02)), engine=engine)
    scattering = math.log1p(math.exp(0.7 / (2 * math.sqrt(math.pi))))
    for v, view in enumerate(VIEWS):
        frame = torch.from_numpy(radar_frame(view))
        plane = (frame @ covariance(scene.quaternions, scene.scales)[0] @ frame.T)[:2, :2]
        whole = scattering * kappa * 2 * math.pi * math.sqrt(float(torch.linalg.det(plane)))
        # the cut at τ = 1e-3 loses its share 1e-3/κ of the integral, saturation κ/4 of it
        expected = whole * (1 - 1e-3 / kappa - kappa / 4)
        assert float(rendering.cross_sections[v, 0, 0]) == pytest.approx(expected, rel=1e-3)


# ---- 3. attenuation --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["overlap", "opaque", "needles", "oblong rays", "depth ties"])
def test_what_is_lit_is_what_does_not_pass(engine, name):
    """Σ_i w_i = 1 − T_end, summed over the rays of a view."""
    scene = MATRIX[name]()
    rendering = scene.call(
        render, {k: t.to(DTYPE[engine]) for k, t in scene.leaves(torch.float64).items()}, engine=engine
    )
    rays = scene.rays or RayGrid.for_image(scene.grid)
    for lit, ray_map in zip(rendering.lit_area, rendering.ray_maps, strict=True):
        stopped = rays.cell_area * float((1 - ray_map.transmittance.detach().double()).sum())
        assert float(lit.double().sum()) == pytest.approx(stopped, rel=1e-6)


@pytest.mark.parametrize("kappa", [0.5, 2.0, 8.0, 30.0])
def test_behind_a_wall(engine, kappa):
    small = one(0.8, scales=(0.1, 0.15, 0.1), mean=(0.0, 0.0, 0.0))
    wall = one(kappa, scales=(3.0, 3.0, 3.0), mean=tuple(5.0 * VIEWS[0].direction))
    rays = RayGrid((0.05, 0.05))
    dtype = DTYPE[engine]
    free = render(small.to(dtype), VIEWS[:1], GRID, rays=rays, engine=engine).cross_sections[0, 0, 0]
    behind = render(Gaussians.cat([small, wall]).to(dtype), VIEWS[:1], GRID, rays=rays, engine=engine).cross_sections[
        0, 0, 0
    ]
    if kappa == 30.0:
        assert float(behind) == 0.0  # past the early stop
    else:
        thinnest = kappa * math.exp(-0.5 * (0.6 / 3.0) ** 2)  # optical depth of the wall in front of any part of it
        assert math.exp(-kappa) * float(free) <= float(behind) <= math.exp(-thinnest) * float(free)


# ---- 4. symmetries ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("angle", [90.0, 33.0, -140.0])
def test_turning_scene_and_radar_together(engine, angle):
    scene = cloud(40, 16).to(DTYPE[engine])
    half = math.radians(angle) / 2
    w, x, y, z = scene.quaternions.unbind(1)
    c, s = math.cos(half), math.sin(half)
    turn = rotation_matrix(torch.tensor([c, 0.0, 0.0, s], dtype=torch.float64))
    # harmonics of the turned scene at a turned direction are those of the scene at the direction
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(1)).double())
    mixing = torch.linalg.lstsq(harmonic_basis(directions @ turn.T, 3), harmonic_basis(directions, 3)).solution
    turned = replace(
        scene,
        means=scene.means @ turn.T.to(DTYPE[engine]),
        scattering=replace(scene.scattering, parameters=scene.scattering.parameters @ mixing.T.to(DTYPE[engine])),
        quaternions=torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], dim=1),
    )
    views = [View(view.azimuth_deg - angle, view.grazing_deg) for view in VIEWS]  # counter-clockwise: φ → φ − α
    before, after = render(scene, VIEWS, GRID, engine=engine), render(turned, views, GRID, engine=engine)
    assert relative(after.images, before.images) <= EXACT[engine]
    assert relative(after.cross_sections, before.cross_sections) <= EXACT[engine]


def test_images_are_linear_in_the_scattering(engine):
    scene = MATRIX["amplitudes given"]()
    leaves = {k: t.to(DTYPE[engine]) for k, t in scene.leaves(torch.float64).items()}
    once = scene.call(render, leaves, engine=engine)
    twice = scene.call(render, leaves | {"amplitudes": 3 * leaves["amplitudes"]}, engine=engine)
    assert relative(twice.images, 3 * once.images) <= EXACT[engine]
    assert torch.equal(twice.lit_area, once.lit_area)


def test_order_of_the_gaussians_does_not_matter(engine):
    scene = cloud(60, 1, kappa=(4.0, 12.0)).to(DTYPE[engine])
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    before, after = render(scene, VIEWS, GRID, engine=engine), render(scene[order], VIEWS, GRID, engine=engine)
    assert relative(after.images, before.images) <= EXACT[engine]
    assert relative(after.cross_sections, before.cross_sections[:, order]) <= EXACT[engine]


def test_views_do_not_know_of_each_other(engine):
    scene = cloud(40, 2).to(DTYPE[engine])
    together = render(scene, VIEWS, GRID, engine=engine)
    for v, view in enumerate(VIEWS):
        assert (
            relative(together.channel(0)[v], render(scene, [view], GRID, engine=engine).channel(0)[0]) <= EXACT[engine]
        )


def test_finer_rays_change_nothing(engine):
    scene = with_scales(cloud(20, 8, size=(1.5, 1.5, 1.0)), (0.16, 0.12, 0.14)).to(DTYPE[engine])
    coarse, fine = (render(scene, VIEWS, GRID, rays=RayGrid((d, d)), engine=engine).images for d in (0.06, 0.03))
    assert relative(coarse, fine) <= 0.01
