"""SAR-NeRF: closed forms, gradients, invariances, and a sphere that it must learn."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from made_runs import baseline_losses
from sarsplat.baselines.baseline import Scene
from sarsplat.baselines.fields import Field, Rays, encoded, isosurface, level_of_half
from sarsplat.baselines.method_sar_nerf import SarNerf, SarNerfConfig, scene_boxes
from sarsplat.baselines.method_sar_nerf_grid import SarNerfGrid, SarNerfGridConfig
from sarsplat.geometry import ImageGrid, View, radar_frame

GRID = ImageGrid(24, 18, (0.3, 0.25), (0.3, 0.3), (0.1, -0.2))  # neither square nor centred
VIEW = View(35.0, 40.0)
LOW, HIGH = np.array([-1.2, -0.9, -0.6]), np.array([1.5, 0.8, 0.7])
KINDS = [(field, mode) for field in ("mlp", "grid") for mode in ("published", "sound")]


def scene(views=(VIEW,), grid=GRID, low=LOW, high=HIGH, **fields) -> Scene:
    return Scene(tuple(views), grid, low, high, 1.0, **fields)


def config(field="grid", mode="sound", **changes) -> SarNerfConfig:
    base = SarNerfGridConfig() if field == "grid" else SarNerfConfig()
    own = {name: value for name, value in changes.items() if hasattr(base, name)}  # a perceptron has no voxels
    return replace(base, mode=mode, **own)


class Given(Field):
    """Attenuation and scattering, before their activations, as functions of the place."""

    at_once = 1 << 20

    def __init__(self, attenuation, scattering):
        super().__init__()
        self.functions = attenuation, scattering
        self.one = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, places, direction):
        return tuple(self.one * f(places) for f in self.functions)

    def attenuation(self, places):
        return self.functions[0](places)


def model(what, settings) -> Any:
    return (SarNerfGrid if isinstance(settings, SarNerfGridConfig) else SarNerf)(what, settings)


def baseline_of(attenuation, scattering, mode, what=None, **changes) -> SarNerf:
    """With these raw values; the published activations are those of the perceptron."""
    baseline = model(scene() if what is None else what, config("grid" if mode == "sound" else "mlp", mode, **changes))
    baseline.field = Given(attenuation, scattering)
    return baseline


def constant(value):
    return lambda places: torch.full_like(places[:, 0], value)


def inverse_softplus(value: float) -> float:
    return math.log(math.expm1(value))


@pytest.mark.parametrize("rows", [24, 7])
def test_a_uniform_slab_as_published(rows):
    """Without ends, Σ_k S·exp(−(row + 1)·α): the cell itself attenuates, and a cell has no length."""
    alpha, scattering, brightest = 0.07, 0.3, 5.0
    what = scene(grid=replace(GRID, rows=rows), brightest=brightest)
    baseline = baseline_of(constant(alpha), constant(math.log(scattering / (1 - scattering))), "published", what)
    amplitude = 20 * scattering * np.exp(-alpha * (1 + np.arange(rows)))
    expected = np.broadcast_to(brightest * amplitude[:, None] ** 2, (rows, GRID.columns))
    np.testing.assert_allclose(baseline.image(VIEW).detach(), expected, rtol=1e-12)


def test_a_uniform_slab_in_metres():
    """Seen along x: γ⁰·(height/Δr)·exp(−2·α·depth)·(1 − exp(−2·α·Δr)), whatever the number of rays."""
    view, alpha, gamma0 = View(0.0, 1e-6), 0.4, 0.7
    grid = ImageGrid(24, 18, (0.3, 0.25), (0.3, 0.3))
    low, high = np.array([-1.0, -1.2, -0.5]), np.array([1.0, 1.2, 0.8])  # 8 cells deep, 8 columns wide
    what = scene([view], grid, low, high)
    raw = inverse_softplus(alpha * grid.cell_m) + 4.0
    for rays in (20, 7):
        baseline = baseline_of(constant(raw), constant(inverse_softplus(gamma0) + 2.0), "sound", what, rays=rays)
        image = baseline.image(view).detach().numpy()
        behind = np.arange(8) * 0.25
        expected = np.zeros((24, 18))
        profile = gamma0 * 1.3 / 0.25 * np.exp(-2 * alpha * behind) * -math.expm1(-2 * alpha * 0.25)
        expected[8:16, 5:13] = profile[:, None]
        np.testing.assert_allclose(image, expected, rtol=1e-5, atol=1e-12)
    assert baseline.image(view).sum().item() * 0.25 == pytest.approx(
        8 * gamma0 * 1.3 * -math.expm1(-2 * alpha * 2.0), rel=1e-5
    )


def spot(at, radius=0.3):
    at = torch.from_numpy(at)
    return lambda places: torch.where((places - at).norm(dim=1) < radius, 8.0, -1e3).to(places)


@pytest.mark.parametrize("view", [VIEW, View(200.0, 15.0), View(-70.0, 75.0)])
@pytest.mark.parametrize("mode", ["published", "sound"])
def test_one_scatterer_appears_where_the_radar_frame_says(mode, view):
    at = np.array([0.7, -0.4, 0.3])
    x, _, z = radar_frame(view) @ at
    image = baseline_of(spot(at), spot(at), mode, scene([view]), rays=60).image(view).detach().numpy()
    azimuth = (image.sum(0) * GRID.azimuth_m).sum() / image.sum()
    lit = GRID.range_m[image.max(1) > 0]
    assert abs(azimuth - x) < 0.1
    assert abs((lit[0] + lit[-1]) / 2 - z) < 0.25 if mode == "sound" else abs(lit[0] - (z - 0.3)) < 0.26
    assert image.max() > 0


@pytest.mark.parametrize("mode", ["published", "sound"])
def test_what_is_behind_lies_in_the_shadow(mode):
    away = radar_frame(VIEW)[2]
    near, far = -0.5 * away, 0.5 * away
    row = int(np.abs(GRID.range_m - 0.5).argmin())

    def both(places):
        return torch.maximum(spot(near)(places), spot(far)(places))

    alone = baseline_of(spot(far), spot(far), mode).image(VIEW)[row].max().item()
    hidden = baseline_of(both, both, mode).image(VIEW)[row].max().item()
    assert hidden < 1e-3 * alone


@pytest.mark.parametrize(("field", "mode"), KINDS)
def test_gradients_are_those_of_finite_differences(field, mode):
    torch.manual_seed(0)
    what = scene(grid=replace(GRID, rows=9, columns=7), looks=1.0 if mode == "sound" else None, brightest=0.7)
    baseline = model(what, config(field, mode, rays=3, voxel=2.0, levels=2, degree=2)).double()
    chosen, images = torch.tensor([0]), torch.rand(1, 9, 7, dtype=torch.float64)
    with torch.no_grad():
        for parameter in baseline.parameters():
            parameter += 0.01 * torch.rand_like(parameter)

    def loss():
        return baseline.loss(chosen, images, torch.Generator().manual_seed(3))

    loss().backward()
    for parameter in baseline.parameters():
        step = parameter.grad / parameter.grad.norm() * 1e-6  # no other direction has so few kinks in it
        values = []
        with torch.no_grad():
            for sign in (1, -2):
                parameter += sign * step
                values.append(loss().item())
            parameter += step
        expected = (values[0] - values[1]) / 2
        assert parameter.grad.norm().item() * 1e-6 == pytest.approx(expected, rel=2e-4, abs=1e-13)


@pytest.mark.parametrize(("field", "mode"), KINDS)
def test_parts_are_the_whole(field, mode):
    """Columns computed in parts, and again on the way back, make the same image and gradient."""
    baseline = model(scene(), config(field, mode, rays=4)).double()
    results = []
    for at_once in (1 << 20, 100):
        baseline.field.at_once = at_once
        baseline.zero_grad()
        image = baseline.image(VIEW)
        (image**2).sum().backward()
        results.append((image.detach(), [p.grad.clone() for p in baseline.parameters()]))
    torch.testing.assert_close(results[0], results[1], rtol=1e-9, atol=1e-12)


def test_turning_scene_and_view_together_changes_nothing():
    """By a quarter turn counter-clockwise, x → y and y → −x: then the box stays one."""
    baseline = model(scene(), config(degree=0, levels=2)).double()
    turned_low, turned_high = np.array([-HIGH[1], LOW[0], LOW[2]]), np.array([-LOW[1], HIGH[0], HIGH[2]])
    other_view = View(VIEW.azimuth_deg - 90.0, VIEW.grazing_deg)
    other = model(scene([other_view], low=turned_low, high=turned_high), config(degree=0, levels=2)).double()
    torch.manual_seed(0)
    with torch.no_grad():
        for mine, its in zip(baseline.field.tables, other.field.tables, strict=True):
            mine.copy_(torch.randn_like(mine))
            its.copy_(mine.transpose(2, 3).flip(3))  # [c, z, y, x]: new x = −y, new y = x
    image = baseline.image(VIEW)
    assert image.max() > 0
    torch.testing.assert_close(other.image(other_view), image, rtol=1e-9, atol=1e-12)


def test_scale_changes_nothing():
    """A scene ten times as large in pixels ten times as large is the same image."""
    baselines = [
        model(
            scene(grid=ImageGrid(24, 18, (0.3 * k, 0.25 * k), (0.3 * k, 0.3 * k)), low=LOW * k, high=HIGH * k),
            config(field),
        ).double()
        for field in ("mlp", "grid")
        for k in (1.0, 10.0)
    ]
    for one, ten in zip(baselines[::2], baselines[1::2], strict=True):
        torch.testing.assert_close(one.image(VIEW), ten.image(VIEW), rtol=1e-5, atol=1e-9)


def test_rays_stay_in_their_strata_and_reach_the_edges():
    rays = Rays.through(VIEW, GRID, LOW, HIGH, 20, whole=False)
    corners = np.array([[(LOW, HIGH)[i >> k & 1][k] for k in range(3)] for i in range(8)]) @ rays.turn.T
    np.testing.assert_allclose(rays.elevation_m, [corners[:, 1].min(), corners[:, 1].max()])
    drawn = rays.offsets(torch.Generator().manual_seed(1))
    strata = (drawn - rays.elevation_m[0]) / rays.spacing_m
    assert (strata.floor() == torch.arange(20)).all()
    assert strata.frac().std() > 0.25
    middles = rays.offsets(None)
    np.testing.assert_allclose(middles.mean(1), np.mean(rays.elevation_m))
    places = rays.places(middles, slice(2, 4), torch.zeros(1, dtype=torch.float64))
    radar = places.numpy() @ rays.turn.T
    np.testing.assert_allclose(radar[..., 0], np.broadcast_to(rays.azimuth_m[2:4, None, None], radar.shape[:3]))
    np.testing.assert_allclose(radar[..., 2], np.broadcast_to(rays.range_m, radar.shape[:3]))
    # only pixels of the box are sampled
    assert len(rays.azimuth_m) < GRID.columns and len(rays.range_m) < GRID.rows
    everything = Rays.through(VIEW, GRID, LOW, HIGH, 2, whole=True)
    assert (len(everything.azimuth_m), len(everything.range_m)) == (GRID.columns, GRID.rows)


def test_positions_are_encoded_with_the_raw_input():
    values = torch.tensor([[0.3, -1.2]])
    code = encoded(values, 3)[0]
    assert code.shape == (14,)
    for angle in (0.3, -1.2, 0.6, -2.4, 1.2, -4.8):
        assert torch.isclose(code, torch.tensor(math.sin(angle))).any()
        assert torch.isclose(code, torch.tensor(math.cos(angle))).any()
    assert (code[:2] == values).all()


@pytest.mark.parametrize("field", ["mlp", "grid"])
def test_the_same_seed_gives_the_same_bits_and_leaves_torchs_alone(field):
    state = torch.get_rng_state()
    images = [model(scene(), config(field, seed=seed)).image(VIEW) for seed in (5, 5, 6)]
    assert (torch.get_rng_state() == state).all()
    assert (images[0] == images[1]).all()
    assert field == "grid" or not (images[0] == images[2]).all()  # a grid starts at 0


@pytest.mark.parametrize("field", ["grid", "mlp"])
def test_threads_change_no_bits(field, threads):
    """Over two steps; the perceptron's products are split the same way here, which torch does not promise."""
    images, results = torch.rand(1, GRID.rows, GRID.columns, generator=torch.Generator().manual_seed(0)), []
    for count in (1, 2):
        threads(count)
        baseline = model(scene(ground=field == "grid", looks=1.0), config(field, "sound", rays=4))
        baseline_losses(baseline, images, 2)
        many = torch.linspace(-9, 9, 100_003)  # so many that torch splits them
        results.append(
            [*(parameter.detach().clone() for parameter in baseline.parameters()), baseline._scattering(many)]
        )
    assert all((one == two).all() for one, two in zip(*results, strict=True))


def test_what_lies_outside_the_boxes_is_not_computed():
    """With ground, that is most of space: the field sees no place above the ground beside the target."""
    baseline = model(scene(ground=True), config())
    seen = []
    baseline.field.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    baseline.image(VIEW)
    places = torch.cat(seen).double().numpy()
    target = ((places >= LOW - 1e-5) & (places <= HIGH + 1e-5)).all(1)
    assert target.any() and not target.all()
    assert np.abs(places[~target, 2]).max() <= GRID.cell_m + 1e-5


def test_with_ground_the_field_reaches_over_the_image():
    target, (low, high) = scene_boxes(scene(ground=True))
    assert (target[0] == LOW).all() and (target[1] == HIGH).all()
    level = VIEW.direction[:2] / np.linalg.norm(VIEW.direction[:2])
    for row, column in [(0, 0), (0, -1), (-1, 0), (-1, -1)]:
        along = -GRID.range_m[row] / math.cos(math.radians(VIEW.grazing_deg))  # towards the radar, on the ground
        ground = radar_frame(VIEW)[0] * GRID.azimuth_m[column] + along * np.array([*level, 0.0])
        assert (low < ground).all() and (ground < high).all()
    assert low[2] < 0 < high[2]
    assert model(scene(ground=True, looks=1.0), config()).image(VIEW).min() > 0  # the noise floor


def test_over_ground_no_pixel_is_without_rays():
    """Thin ground appears in every pixel, also by rays in fixed places, and however few were asked for."""
    what = scene([View(35.0, 20.0)], ground=True, looks=1.0)
    baseline = baseline_of(constant(0.0), constant(0.0), "sound", what, rays=2)
    noise = baseline.log_noise.exp().item()
    assert baseline.image(what.views[0]).min() > noise * 1.01


def test_speckle_alone_is_smoothed_and_the_less_the_more_is_measured():
    """One node that differs by 3 from its six neighbours costs 9 of each, as nats of one pixel of all the images."""

    def losses(count, weight, looks):
        what = scene([VIEW] * count, looks=looks)
        baseline = model(what, config(levels=1, total_variation=weight)).double()
        with torch.no_grad():
            baseline.field.tables[0][0, 2, 2, 2] = 3.0
        return baseline.loss(torch.tensor([0]), torch.ones(1, 24, 18), torch.Generator().manual_seed(0)).item()

    for count, looks in ((1, 1.0), (4, 1.0), (4, 2.0)):
        cost = losses(count, 0.5, looks) - losses(count, 0.0, looks)
        assert cost == pytest.approx(0.5 * 6 * 9 / (count * GRID.independent_samples * looks), rel=1e-9)
    assert losses(1, 0.5, None) == losses(1, 0.0, None)


@pytest.mark.parametrize(("count", "harmonics"), [(1, 1), (7, 1), (8, 4), (17, 4), (18, 9), (36, 9)])
def test_few_speckled_images_have_few_harmonics(count, harmonics):
    views = [VIEW] * count
    assert len(model(scene(views, looks=1.0), config(levels=1)).field.tables[0]) == 1 + harmonics
    assert len(model(scene(views), config(levels=1)).field.tables[0]) == 10


def test_the_level_is_where_half_is_hidden():
    wall = torch.tensor([0.0, 0.0, 0.1, 0.3, 0.5, 0.6, 0.0]).repeat(4, 1)  # ln 2 is reached in the fifth cell
    assert level_of_half([wall, 2 * wall[:1]]) == 0.5
    assert level_of_half([0.01 * wall]) == math.inf


def test_the_isosurface_of_a_ball():
    def ball(places):
        return 2.0 - (places - torch.tensor([0.1, -0.1, 0.0])).norm(dim=1)

    vertices, faces = isosurface(ball, LOW, HIGH, 64, 1.5, torch.zeros(1))
    np.testing.assert_allclose(np.linalg.norm(vertices - [0.1, -0.1, 0.0], axis=1), 0.5, atol=0.01)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6  # positive: faces look outwards
    assert volume == pytest.approx(4 / 3 * math.pi * 0.5**3, rel=0.02)
    # open where it leaves the box
    vertices, faces = isosurface(ball, LOW, HIGH, 32, 0.9, torch.zeros(1))
    np.testing.assert_allclose(np.linalg.norm(vertices - [0.1, -0.1, 0.0], axis=1), 1.1, atol=0.02)
    assert (vertices.min(0) > LOW).all() and (vertices.max(0) < HIGH).all()
    assert len(isosurface(ball, LOW, HIGH, 8, 0.1, torch.zeros(1))[1]) == 0  # higher everywhere
    assert len(isosurface(ball, LOW, HIGH, 8, math.inf, torch.zeros(1))[1]) == 0


VIEWS = tuple(View(a, g) for g in (20.0, 45.0, 70.0) for a in range(0, 360, 45))
BALL_GRID = ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3))
BALL_LOW, BALL_HIGH = np.array([-1.5, -1.5, -1.5]), np.array([1.5, 1.5, 1.5])


def ball_images(mode, radius=0.9):
    """An opaque ball in a box three metres wide, by the same equation with many rays: what it must be able to learn."""
    what = scene(VIEWS, BALL_GRID, BALL_LOW, BALL_HIGH)

    def solid(places):
        return torch.where(places.norm(dim=1) < radius, 6.0, -30.0).to(places)

    teacher = baseline_of(solid, solid if mode == "published" else constant(0.0), mode, what, rays=60)
    images = torch.stack([teacher.image(view).detach() for view in VIEWS]).float()
    return images / images.max()


@pytest.mark.parametrize("mode", ["published", "sound"])
def test_a_ball_is_learned(mode):
    images = ball_images(mode)
    unseen = View(100.0, 35.0)
    baseline = model(
        scene(VIEWS, BALL_GRID, BALL_LOW, BALL_HIGH), config("grid", mode, surface_voxels=32, iterations=100)
    )

    def error() -> float:
        return float(np.square(np.sqrt(baseline.images(VIEWS)) - images.sqrt().numpy()).mean())

    before = error()
    baseline_losses(baseline, images, 100)
    after = error()
    assert after < (0.6 if mode == "published" else 0.05) * before, (before, after)
    assert baseline.image(unseen).isfinite().all()
    if mode == "sound":  # the published equation has more solutions
        vertices, _ = baseline.surface()
        distance = np.abs(np.linalg.norm(vertices, axis=1) - 0.9)
        assert np.median(distance) < 0.3
