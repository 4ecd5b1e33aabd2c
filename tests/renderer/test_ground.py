"""The ground is where rays end: its level, its shadows and what it hides, where it is level and where it is terrain."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from named_scenes import GRID, MATRIX, VIEWS, cloud, wall
from scipy.special import erfinv

from made import hill, slope, terrain
from sarsplat import Gaussians, Ground, ImageGrid, RayGrid, SarsplatError, Terrain, View, radar_frame, render
from sarsplat.geometry.view import ground_radius_m
from sarsplat.renderer.echoes import lit_terrain
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.ground import free_plane
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.engines.choice import passes_for

WIDE = ImageGrid(48, 40, (0.3, 0.25), (0.45, 0.4))


def lattice(view: View, rays: RayGrid, transmittance, height_m: float = 0.0, grid: ImageGrid = WIDE) -> RayEnds:
    """Rays that cover a square of 12 m of the plane around the origin, with T(x_r, slant range) of the ground there."""
    dx, dy = rays.spacing_m
    theta = math.radians(view.grazing_deg)
    columns, rows = math.ceil(6 / dx), math.ceil(6 * math.sin(theta) / dy)
    x, y = ((np.arange(-n, n) + 0.5) * d for n, d in ((columns, dx), (rows, dy)))
    r = (y * math.cos(theta) - height_m) / math.sin(theta)
    left = torch.from_numpy(
        np.broadcast_to(transmittance(x[None, :], r[:, None]), (2 * rows, 2 * columns)).astype(float)
    )
    return RayEnds(left.flatten(), [(2 * rows, 2 * columns)], [(float(x[0]), float(y[0]))])


def lit(
    ends: RayEnds,
    view: View,
    rays: RayGrid,
    dtype: torch.dtype,
    height_m: float = 0.0,
    shift: torch.Tensor | None = None,
) -> torch.Tensor:
    ends = replace(ends, transmittance=ends.transmittance.to(dtype))
    new_pass = passes_for("auto", {"transmittance": ends.transmittance})
    return lit_ground(ends, [view], WIDE, rays, height_m, shift, new_pass)[0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grazing", [5.0, 17.0, 45.0, 60.0, 85.0])
def test_lit_ground_is_flat_whatever_the_angle_and_the_rays(grazing, dtype):
    view = View(35.0, grazing)
    for spacing in ((0.02, 0.03), (0.4, 0.7)):
        rays = RayGrid(spacing)
        shares = lit(lattice(view, rays, lambda x, r: 0.3), view, rays, dtype)
        inner = shares[np.abs(WIDE.range_m) < 6 * math.cos(math.radians(grazing)) - 1.5]
        assert len(inner) > 2 or grazing > 70
        torch.testing.assert_close(inner[:, 4:-4], torch.full_like(inner[:, 4:-4], 0.3), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("engine", ["cpu", "reference"])
@pytest.mark.parametrize("grazing", [5.0, 17.0, 45.0, 85.0])
def test_free_ground_has_the_level_of_its_gamma0(grazing, engine):
    dtype = torch.float32 if engine == "cpu" else torch.float64
    far = cloud(5, 0)
    far = replace(far, means=far.means + torch.tensor([500.0, 0.0, 3.0])).to(dtype)
    view, ground = View(120.0, grazing), Ground(torch.tensor(0.2, dtype=dtype), exponent=torch.tensor(1.5, dtype=dtype))
    for scene in (far, far[:0]):
        images = render(scene, [view], WIDE, rays=RayGrid((0.1, 0.1)), ground=ground, engine=engine).images
        sine, tangent = math.sin(math.radians(grazing)), math.tan(math.radians(grazing))
        torch.testing.assert_close(images, torch.full_like(images, 0.2 * sine**1.5 * tangent))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grazing", [10.0, 45.0, 70.0])
def test_an_edge_of_shadow_is_where_rays_say(grazing, dtype):
    """Half of the level lies on the edge between two rays' cells, along range and along azimuth; also when shifted."""
    view, rays, height_m = View(250.0, grazing), RayGrid((0.05, 0.05 * math.sin(math.radians(grazing)))), 0.7
    ends = lattice(view, rays, lambda x, r: ~((x < 0.4) & (r < 0.3)), height_m)
    dx, dy = rays.spacing_m
    theta = math.radians(grazing)
    last_y = math.floor((0.3 * math.sin(theta) + height_m) / math.cos(theta) / dy - 0.5) + 1
    edge_r = (last_y * dy * math.cos(theta) - height_m) / math.sin(theta)
    edge_x = (math.floor(0.4 / dx - 0.5) + 1) * dx
    for shift in (None, torch.tensor([[0.13, -0.21]], dtype=dtype)):
        moved = (0.0, 0.0) if shift is None else shift[0].tolist()
        shares = lit(ends, view, rays, dtype, height_m=height_m, shift=shift)
        for profile, places, edge, by in (
            (shares[:, 12], WIDE.range_m, edge_r, moved[1]),
            (shares[20, :], WIDE.azimuth_m, edge_x, moved[0]),
        ):
            level = profile.double().numpy()
            inside = slice(np.argmax(level < 0.3), None)
            after = inside.start + int(np.argmax(level[inside] > 0.5))
            # between pixels the error function is interpolated by its argument
            low, high = (math.sqrt(2) * erfinv(2 * level[k] - 1) for k in (after - 1, after))
            found = places[after - 1] + (places[after] - places[after - 1]) * -low / (high - low)
            assert found == pytest.approx(edge + by, abs=2e-4)


def test_what_the_ground_loses_is_what_rays_lose():
    """Energy: Σ β⁰ ΔaΔr that is missing is γ⁰ times the area, across the line of sight, of what is hidden."""
    view, rays = View(20.0, 40.0), RayGrid((0.07, 0.06))
    scene = replace(cloud(30, 3, size=(3.0, 3.0, 1.0), scale=0.2, kappa=(0.5, 3.0)))
    scene = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 1.0]))
    ground = Ground(torch.tensor(0.25))
    rendering = render(scene, [view], WIDE, rays=rays, ground=ground, first_return_depth=0.5)
    level = 0.25 * math.tan(math.radians(40))
    missing = float((level - rendering.ground.double()).sum()) * 0.3 * 0.25
    (left,) = rendering.ray_maps
    assert missing == pytest.approx(0.25 * rays.cell_area * float((1 - left.transmittance.double()).sum()), rel=1e-3)
    alone = render(scene, [view], WIDE, rays=rays)
    assert alone.ground is None and torch.equal(rendering.cross_sections, alone.cross_sections)
    expected = alone.images[:, 0] + rendering.ground
    torch.testing.assert_close(rendering.images[:, 0], expected)


def test_texture_lies_where_it_is_on_the_ground():
    """γ⁰ that grows linearly with x and y, up to the last places, against the geometry inverted by a matrix."""
    steps = torch.arange(-20, 21, dtype=torch.float64) * 0.8
    table = 2.0 + 0.03 * steps[None, :] - 0.05 * steps[:, None]  # [y, x]
    view, height_m = View(130.0, 35.0), 0.9
    shift = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    found = free_plane(Ground(table, 0.8), height_m, [view], WIDE, shift)[0]
    frame = radar_frame(view)
    x_r, r = np.meshgrid(WIDE.azimuth_m - 0.3, WIDE.range_m + 0.2)
    # x_r and r fix two coordinates, the height the third
    matrix = np.stack([frame[0], frame[2], [0.0, 0.0, 1.0]])
    world = np.linalg.solve(matrix, np.stack([x_r, r, np.full_like(r, height_m)]).reshape(3, -1)).reshape(3, *r.shape)
    expected = (2.0 + 0.03 * world[0] - 0.05 * world[1]) * math.tan(math.radians(35))
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    beyond = free_plane(Ground(table[18:23, 18:23], 0.8), 0.0, [view], WIDE)[0]
    assert float(beyond.min()) >= float(table[18:23, 18:23].min()) * math.tan(math.radians(35)) - 1e-12


def test_what_is_below_the_ground_is_not_seen_and_throws_no_shadow():
    scene = cloud(20, 1, size=(2.0, 2.0, 0.5))
    buried = replace(cloud(20, 2), means=cloud(20, 2).means - torch.tensor([0.0, 0.0, 2.0]))
    ground = Ground(torch.tensor(0.3), height_m=-1.0)
    alone = render(scene, VIEWS, GRID, ground=ground)
    both = render(Gaussians.cat([scene, buried]), VIEWS, GRID, ground=ground)
    torch.testing.assert_close(both.images, alone.images)
    assert not both.lit_area[:, 20:].any()


def test_the_ground_reaches_past_the_farthest_corner_of_the_images():
    grid = ImageGrid(40, 30, (0.3, 0.2), (0.5, 0.4), (2.0, -1.5))
    for view in (View(0, 30), View(75, 60)):
        to_ground = np.linalg.inv(radar_frame(view)[[0, 2], :2])
        edges = [
            axis[[0, -1]] + np.array([-0.5, 0.5]) * step
            for axis, step in zip((grid.azimuth_m, grid.range_m), grid.spacing_m, strict=True)
        ]
        corners = to_ground @ np.stack(np.meshgrid(*edges)).reshape(2, -1)
        assert ground_radius_m([view], grid) == pytest.approx(np.linalg.norm(corners, axis=0).max() + 2 * 0.5)
        assert ground_radius_m([view, View(10, 80)], grid) == pytest.approx(ground_radius_m([View(10, 80)], grid))


# ---- terrain ---------------------------------------------------------------------------------------------------------
FINE = ImageGrid(60, 24, (0.3, 0.1), (0.45, 0.16))
DTYPES = {"cpu": torch.float32, "reference": torch.float64}


def bare(ground: Terrain, view: View, grid: ImageGrid, engine: str = "cpu", rays: RayGrid | None = None) -> np.ndarray:
    """β⁰ of terrain alone over γ⁰."""
    dtype = DTYPES[engine]
    empty = cloud(1, 0)[:0].to(dtype)
    of = Ground(torch.tensor(0.2, dtype=dtype), height_m=ground)
    return render(empty, [view], grid, rays=rays, ground=of, engine=engine).images[0, 0].double().numpy() / 0.2


@pytest.mark.parametrize("engine", DTYPES)
@pytest.mark.parametrize("many", [False, True])
def test_flat_terrain_is_the_plane(engine, many):
    dtype = DTYPES[engine]
    flat = Terrain(np.full((4, 7), -0.55), (2.0, 1.5))
    gamma0 = torch.full((3, 5), 0.3, dtype=dtype) if many else torch.tensor(0.3, dtype=dtype)
    scene, exponent = cloud(20, 30).to(dtype), torch.tensor(1.2, dtype=dtype)
    shift = torch.tensor([[0.1, -0.2], [0.0, 0.3], [-0.2, 0.1]], dtype=dtype)
    found, expected = (
        render(scene, VIEWS, GRID, shift=shift, ground=Ground(gamma0, 0.9, height, exponent), engine=engine)
        for height in (flat, -0.55)
    )
    torch.testing.assert_close(found.images, expected.images, rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(found.lit_area, expected.lit_area)


@pytest.mark.parametrize("engine", DTYPES)
@pytest.mark.parametrize(("grazing", "tilt"), [(40.0, 15.0), (40.0, -15.0), (60.0, 45.0), (20.0, -19.0), (75.0, 5.0)])
def test_a_slope_is_as_bright_as_its_own_angle_makes_it(engine, grazing, tilt):
    """β⁰ = γ⁰·tan(θ + tilt), beyond 90° in layover over what is level before and behind it.

    Seen from the side, a tilt moves places but leaves their areas.
    """
    theta = math.radians(grazing + tilt)
    ground = slope(tilt)
    rays = RayGrid((0.21, 0.07))
    toward = bare(ground, View(0.0, grazing), FINE, engine, rays)[20:40, 5:-5]
    level = math.tan(math.radians(grazing))
    np.testing.assert_allclose(toward, abs(math.tan(theta)) + (2 * level if grazing + tilt > 90 else 0), rtol=2e-4)
    beside = bare(ground, View(90.0, grazing), FINE, engine, rays)[20:40, 5:-5]
    np.testing.assert_allclose(beside, level, rtol=2e-4)


def test_a_slope_that_falls_away_more_steeply_than_rays_is_dark():
    assert bare(slope(-35.0), View(0.0, 25.0), FINE).max() < 1e-6


@pytest.mark.parametrize(("grazing", "fall"), [(30.0, 0.0), (40.0, 10.0), (40.0, -15.0)])
def test_the_shadow_of_a_ridge_on_a_slope(grazing, fall):
    """The ray over a crest of height h meets the ground h / (tan θ − tan of its fall) behind it."""
    theta, down, height = math.radians(grazing), math.tan(math.radians(fall)), 1.0

    def profile(x, y):  # the radar is at +x; steeper than rays, and ground that falls behind
        return np.maximum(height * (1 - np.abs(x) / 0.75), np.minimum(x, 0) * down) + 0 * y

    ground, grid = terrain(profile, pitch_m=(0.25, 1.0)), ImageGrid(90, 16, (0.3, 0.06), (0.45, 0.09))
    image = bare(ground, View(0.0, grazing), grid, rays=RayGrid((0.3, 0.01)))
    level = image[:, 5:-5].mean(1) / math.tan(theta - math.radians(fall))
    far = height / (math.tan(theta) - down)  # on the ground, behind the crest
    edge = far * math.cos(theta) + far * down * math.sin(theta)
    shadow = (grid.range_m > 0.15) & (grid.range_m < edge - 0.2)
    assert shadow.sum() >= 2
    assert level[shadow].max() < 2e-3
    assert level[(grid.range_m > edge + 0.15) & (grid.range_m < edge + 0.6)] == pytest.approx(1.0, abs=5e-3)
    around = np.flatnonzero(np.abs(grid.range_m - edge) < 0.15)
    assert np.interp(0.5, level[around], grid.range_m[around]) == pytest.approx(edge, abs=0.03)


def test_what_terrain_returns_is_what_rays_find():
    """Energy: all rays that end within the image return γ⁰ times their area, whatever the hills."""
    grid, view = ImageGrid(120, 100, (0.3, 0.3), (0.4, 0.4)), View(30.0, 55.0)
    lower = terrain(lambda x, y: 0 * x * y, (15.0, 15.0))
    bump = terrain(lambda x, y: 2.0 * np.exp(-(x**2 + y**2) / 4), (15.0, 15.0))
    flat, bumpy = (bare(one, view, grid).sum() for one in (lower, bump))
    assert bumpy == pytest.approx(flat, rel=1e-4)
    assert np.abs(bare(bump, view, grid) - bare(lower, view, grid)).max() > 1.0


def test_weights_that_are_computed_again_are_those_that_would_be_kept(monkeypatch):
    scene, found = MATRIX["terrain, shifted"](), []
    for at_a_time in (lit_terrain._MAX_SAVED, 5000):
        monkeypatch.setattr(lit_terrain, "_MAX_SAVED", at_a_time)
        leaves = scene.leaves(torch.float64)
        images = scene.call(render, leaves, engine="reference").images
        found.append([images.detach(), *torch.autograd.grad(images.square().sum(), list(leaves.values()))])
    for kept, again in zip(*found, strict=True):
        assert torch.allclose(kept, again, rtol=1e-12, atol=1e-14)


def test_a_hill_hides_what_is_behind_it_and_only_from_there():
    ground = Ground(torch.tensor(0.3), height_m=hill(2.5, at=(2.0, 0.0), width_m=0.8))
    scene = cloud(20, 1, size=(0.4, 0.8, 0.3), scale=0.05)
    scene = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 0.5]))
    views = [View(0.0, 20.0), View(180.0, 20.0), View(0.0, 70.0)]
    both, alone = (render(one, views, GRID, ground=ground) for one in (scene, scene[:0]))
    assert not both.lit_area[0].any()
    torch.testing.assert_close(both.images[0], alone.images[0])
    assert (both.lit_area[1:].sum(1) > 0.05).all()
    buried = replace(scene, means=scene.means - torch.tensor([0.0, 0.0, 3.0]))
    torch.testing.assert_close(render(buried, views, GRID, ground=ground).images, alone.images)


def test_a_wall_on_a_slope_hides_more_of_it_the_more_it_falls():
    """An opaque wall of 2 m across the line of sight hides the slope to 2 m / (tan θ − tan of the fall) behind it."""
    height, grazing = 2.0, 45.0
    grid = ImageGrid(120, 24, (0.1, 0.06), (0.15, 0.09))
    for fall in (-12.0, 0.0, 12.0):
        theta, down = math.radians(grazing), math.tan(math.radians(fall))
        ground = Ground(torch.tensor(0.3), height_m=slope(-fall))
        image = render(
            wall(height, -0.075), [View(0.0, grazing)], grid, rays=RayGrid((0.02, 0.02)), ground=ground
        ).images[0, 0]
        level = image[:, 8:16].mean(1).double().numpy() / (0.3 * math.tan(theta - math.radians(fall)))
        far = height / (math.tan(theta) - down)
        edge = far * math.cos(theta) + far * down * math.sin(theta)
        around = np.flatnonzero(np.abs(grid.range_m - edge) < 0.3)
        found = np.interp(0.5, level[around], grid.range_m[around])
        assert found == pytest.approx(edge, abs=0.05 / math.tan(theta - math.radians(fall)))
        assert level[(grid.range_m > 0.2) & (grid.range_m < edge - 0.3)].max() < 5e-3


def test_angles_at_which_a_ray_is_far_longer_than_the_terrain_are_refused_with_one_that_is_not():
    with pytest.raises(SarsplatError, match=r"grazing 1e-05° looks along \S+ m of ground to see \S+ m") as refused:
        bare(hill(), View(20, 1e-5), GRID)
    least = float(re.search(r"at least (\S+)°", str(refused.value))[1])
    assert least < 0.05
    assert np.isfinite(bare(hill(), View(20, least), GRID)).all()
