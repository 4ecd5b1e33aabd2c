"""Covariances of an interferometric stack, against closed forms and rays that are marched through a scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from compared import check_agreement, check_gradients, differentiated
from named_scenes import cloud

from made import upright
from sarsplat import Gaussians, ImageGrid, Polarimetric, Stack, View, render, render_covariances
from sarsplat.geometry import RayGrid, radar_frame
from sarsplat.renderer.covariances import Sections, lit_planes
from sarsplat.renderer.engines import cpu

WAVELENGTH, VIEW = 0.031, View(20.0, 45.0)


def scene(means, scales, depth, normals: np.ndarray | None = None, gamma0: float = 1.0) -> Gaussians:
    """Discs or balls of the same γ⁰ from all sides; the third axis of each is along its normal."""
    made = upright(means, torch.as_tensor(scales), torch.as_tensor(depth), math.log(math.expm1(gamma0)) / 0.28209479)
    if normals is None:
        return made
    x, y, z = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).T
    turns = np.stack([1 + z, -y, x, 0 * x], axis=1)
    return replace(made, quaternions=torch.as_tensor(turns, dtype=torch.float32))


def sheet(size: float, normal: np.ndarray, pitch: float, reach: float) -> Gaussians:
    """An opaque plane through the scene centre, of discs of one size."""
    across = np.linalg.svd(normal[None])[2][1:]
    steps = np.arange(-reach, reach + pitch, pitch)
    u, v = (axis.ravel() for axis in np.meshgrid(steps, steps))
    means = u[:, None] * across[0] + v[:, None] * across[1] + 1e-4 * np.random.default_rng(0).normal(size=(u.size, 3))
    scales = np.tile([size, size, 0.005], (u.size, 1))
    return scene(means, scales, 3.0, np.tile(normal, (u.size, 1)))


@pytest.mark.parametrize("size", [0.15, 0.5])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.2, 1), (-0.2, 0.5, 1), (0.6, -0.4, 1)])
def test_a_tilted_sheet_of_gaussians_of_any_size_has_the_coherence_of_a_sheet(size: float, normal: tuple) -> None:
    """Elevation y = g · p on it, so that with the response's variances the coherence is exp(−κ² Σ g² σ² / 2)."""
    grid = ImageGrid(7, 7, (0.5, 0.5), (0.6, 0.6))
    stack = Stack(WAVELENGTH, (0.0, WAVELENGTH / 16))  # an elevation of 8 m is a turn
    normal_r = radar_frame(VIEW) @ np.array(normal, float)
    g = -normal_r[[0, 2]] / normal_r[1]
    reach = (4 * size + 4) * (1 + np.abs(g).max())
    found = render_covariances(
        sheet(size, np.array(normal, float), max(0.45 * size, 0.1), reach),
        [VIEW],
        grid,
        stack,
        rays=RayGrid((0.2, 0.2)),
    )[0]
    coherence = found[0, 1] / (found[0, 0] * found[1, 1]).real.sqrt()
    kappa = np.diff(stack.elevation_numbers(VIEW))[0]
    places = np.stack(np.meshgrid(grid.azimuth_m, grid.range_m), axis=-1)
    expected = np.exp(-1j * kappa * places @ g - kappa**2 / 2 * (g**2 @ np.array(grid.response_variance_m2)))
    assert np.abs(coherence.numpy() - expected).max() < 0.01
    assert abs(coherence.abs().mean() - abs(expected).mean()) < 0.005


def slab(height: float, extinction: float, gamma0: float, of_ground: float, grazing: float) -> Gaussians:
    """A volume of small balls, with a two-way extinction per metre, over ground; wide enough for the middle pixels."""
    size, step, chance = 0.5, 0.7, np.random.default_rng(0)
    tangent = math.tan(math.radians(grazing))
    low, high = np.array([-height * tangent - 7, -3.7, 0]), np.array([height / tangent + 7, 3.7, height])
    counts = np.maximum(np.round((high - low) / step), 1).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    balls = low + (cells + chance.random(cells.shape)) * (high - low) / counts
    depth = extinction * np.prod(high - low) / len(balls) / (2 * math.pi * size**2)
    volume = scene(balls, np.full((len(balls), 3), size), depth, gamma0=gamma0)
    if not of_ground:
        return volume
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(low[0], high[0], 0.35), np.arange(-3.7, 3.7, 0.35)))
    places = np.stack([x, y, -0.02 + 1e-3 * chance.normal(size=x.size)], axis=1)
    ground = scene(places, np.tile([0.35, 0.35, 0.01], (x.size, 1)), 5.0, gamma0=of_ground)
    return Gaussians.cat([volume, ground])


LAYERS = [(20, 0.2, 1, 0), (20, 0.5, 1, 0), (20, 0.2, 1, 0.3), (20, 0.2, 1, 2.0), (20, 0.05, 1, 0)]
OTHERS = [(10, 0.3, 1, 0), (30, 0.1, 1, 1.0), (15, 1.0, 1, 0.3)]
RVOG = [*((45.0, *layer) for layer in (*LAYERS, *OTHERS)), *((55.0, *layer) for layer in LAYERS)]


def rvog_errors(grazing: float, height: float, loss_db: float, gamma0: float, of_ground: float) -> list[float]:
    """Of complex coherence, against a random volume over ground (Papathanassiou and Cloude 2001), at three k_z."""
    view, grid, cosine = View(0.0, grazing), ImageGrid(9, 5, (0.5, 0.5), (1.0, 1.0)), math.sin(math.radians(grazing))
    k_z = np.array([0.05, 0.1, 0.2])
    wavelength = 0.23
    sine = math.cos(math.radians(grazing))  # of the incidence
    stack = Stack(wavelength, (0.0, *(k_z * sine * wavelength / (4 * math.pi))))
    extinction = 2 * loss_db / (10 / math.log(10))  # two-way, per metre of path
    gaussians = slab(height, extinction, gamma0, of_ground, grazing)
    with torch.no_grad():
        found = render_covariances(gaussians, [view], grid, stack, rays=RayGrid((0.2, 0.2)))[0].numpy()
    found = found * np.exp(-1j * (lambda p: p[:, None] - p[None])(stack.plane_phases(view, grid)))
    z = (np.arange(20_000) + 0.5) / 20_000 * height
    left = np.exp(extinction / cosine * (z - height))
    through = math.exp(-extinction * height / cosine)
    ratio = of_ground * through / (gamma0 * (1 - through))
    errors = []
    for n, number in enumerate(k_z, 1):
        kappa = stack.elevation_numbers(view)[n]
        blurred = math.exp(-0.5 * (kappa * math.tan(math.radians(grazing))) ** 2 * grid.response_variance_m2[1])
        coherence = found[n, 0].mean() / np.sqrt(found[0, 0].real.mean() * found[n, n].real.mean()) / blurred
        volume = (left * np.exp(1j * number * z)).sum() / left.sum()
        errors.append(abs(coherence - (volume + ratio) / (1 + ratio)))
    return errors


def test_random_volumes_over_ground() -> None:
    errors = [error for case in RVOG for error in rvog_errors(*case)]
    assert len(errors) == 39
    assert np.median(errors) <= 0.005
    assert max(errors) <= 0.015


# ---- a box and a pyramid against rays that are marched through them --------------------------------------------------
def _height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    box = 8.0 * ((np.abs(x) <= 4) & (np.abs(y - 7) <= 4))
    return np.maximum(box, np.clip(5 * (1 - np.maximum(np.abs(x), np.abs(y + 7)) / 6), 0, None))


def _discs(pitch: float = 0.2) -> Gaussians:
    """The scene's surface."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-26, 26, pitch), np.arange(-14, 14, pitch)))
    z = _height(x, y)
    slopes = [
        np.clip((_height(x + dx, y + dy) - _height(x - dx, y - dy)) / 0.02, -2, 2) for dx, dy in ((0.01, 0), (0, 0.01))
    ]
    level = (z == 8) | (z == 0)
    normals = np.stack([*(-np.where(level, 0, slope) for slope in slopes), np.ones_like(z)], axis=1)
    parts = [(np.stack([x, y, z], axis=1), normals)]
    along, up = (
        axis.ravel() for axis in np.meshgrid(np.arange(-4, 4, pitch) + pitch / 2, np.arange(0, 8, pitch) + pitch / 2)
    )
    for side in (-1, 1):
        parts.append((np.stack([0 * up + 4 * side, along + 7, up], axis=1), np.tile([side, 0.0, 0.0], (up.size, 1))))
        parts.append((np.stack([along, 0 * up + 7 + 4 * side, up], axis=1), np.tile([0.0, side, 0.0], (up.size, 1))))
    means, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    means = means + 1e-4 * np.random.default_rng(0).normal(size=means.shape)
    return scene(means, np.tile([0.8 * pitch, 0.8 * pitch, 0.01], (len(means), 1)), 6.0, normals)


def _marched(view: View, grid: ImageGrid, number: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Power, the covariance of two passes, and by how much elevations in a pixel differ; by rays 0.1 m apart."""
    frame, pitch = radar_frame(view), 0.1
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-13, 13, pitch) + 0.05, np.arange(-24, 24, pitch) + 0.05))
    plane = x[:, None] * frame[0] + y[:, None] * frame[1]
    roof = (8 - plane[:, 2]) / frame[2, 2]  # where each ray comes down to the height of the highest
    hit = np.full(x.size, np.nan)
    for depth in np.arange(0, 12, 0.05):  # at 45°, 11.3 m down to the ground
        place = plane + (roof + depth)[:, None] * frame[2]
        hit = np.where((place[:, 2] <= _height(place[:, 0], place[:, 1])) & np.isnan(hit), roof + depth, hit)
    x, y, slant = (array[~np.isnan(hit)] for array in (x, y, hit))
    across, along = (
        np.exp(-0.5 * (axis[:, None] - at) ** 2 / variance) / math.sqrt(2 * math.pi * variance)
        for axis, at, variance in zip(
            (grid.azimuth_m, grid.range_m), (x, slant), grid.response_variance_m2, strict=True
        )
    )
    power, mean, square, pair = (
        (along * (pitch**2 * of_ray)) @ across.T for of_ray in (np.ones_like(y), y, y**2, np.exp(-1j * number * y))
    )
    least = np.maximum(power, 1e-9)
    return power.real, pair, np.sqrt(np.maximum(square.real / least - (mean.real / least) ** 2, 0))


def test_a_box_and_a_pyramid_have_the_phases_of_marched_rays() -> None:
    view, grid = View(0.0, 45.0), ImageGrid(56, 44, (0.5, 0.5), (0.6, 0.6))
    stack = Stack(WAVELENGTH, (0.0, WAVELENGTH / 32))  # an elevation of 16 m is a turn
    with torch.no_grad():
        found = render_covariances(_discs(), [view], grid, stack, rays=RayGrid((0.125, 0.125)))[0].numpy()
    power, pair, spread_m = _marched(view, grid, stack.elevation_numbers(view)[1])
    single = (power > 0.9) & (spread_m < 2)  # of discs, those that stand on an edge bulge over it
    error = np.angle(found[0, 1] * pair.conj())[single]
    assert single.sum() > 1500
    assert np.sqrt((error**2).mean()) < 0.02
    shadow = power < 0.02
    assert shadow.sum() > 50
    assert (np.abs(found[0, 1]) / (found[0, 0].real + 0.1))[shadow].mean() < 0.02  # with noise of 0.1
    layover = (power > 0.9) & ~single
    coherence = [np.abs(c)[layover] / p[layover] for c, p in ((found[0, 1], found[0, 0].real), (pair, power))]
    assert np.abs(coherence[0] - coherence[1]).mean() < 0.05


# ---- what holds for any scene ----------------------------------------------------------------------------------------
def _cloud(count: int = 300) -> Gaussians:
    chance = np.random.default_rng(3)
    means, scales = chance.uniform(-4, 4, (count, 3)), chance.uniform(0.1, 0.6, (count, 3))
    return scene(means, scales, chance.uniform(0.5, 3, count), chance.normal((0, 0, 2), size=(count, 3)))


GRID = ImageGrid(24, 20, (0.4, 0.5), (0.6, 0.7))


def test_they_are_hermitian_and_positive_and_their_diagonal_is_power() -> None:
    stack = Stack(WAVELENGTH, (0.0, 0.001, -0.0015, 0.004))
    views = [VIEW, View(200.0, 30.0)]
    with torch.no_grad():
        found = render_covariances(_cloud(), views, GRID, stack)
        images = render(_cloud(), views, GRID).images
    assert found.shape == (2, 4, 4, 24, 20)
    assert torch.equal(found, found.transpose(1, 2).conj())
    assert torch.equal(found[:, 0, 0], found[:, 3, 3])
    assert float((found[:, 0, 0].real - images[:, 0]).abs().max()) < 3e-3 * float(images.max())
    values = torch.linalg.eigvalsh(found.permute(0, 3, 4, 1, 2).to(torch.complex128))
    assert float(values.min()) > -1e-5 * float(values.max())
    with torch.no_grad():
        alone = render_covariances(_cloud(), [VIEW], GRID, Stack(WAVELENGTH, (0.0,)))
    assert alone.shape == (1, 1, 1, 24, 20)
    assert not alone.imag.any()


def test_gradients_are_those_of_finite_differences() -> None:
    gaussians, stack = _cloud(4).to(torch.float64), Stack(WAVELENGTH, (0.0, 0.0005, 0.002))
    grid, rays = ImageGrid(4, 5, (1.6, 1.5), (1.8, 1.7)), RayGrid((0.7, 0.8))

    def parts(*tensors: torch.Tensor) -> list[torch.Tensor]:
        own = dict(zip(gaussians.tensors(), tensors, strict=True))
        found = render_covariances(gaussians.with_tensors(**own), [VIEW], grid, stack, rays=rays, engine="reference")
        return [found.real, found.imag]

    check_gradients(parts, tuple(tensor.requires_grad_() for tensor in gaussians.tensors().values()), step=1e-7)


def test_engines_agree() -> None:
    stack = Stack(WAVELENGTH, (-0.002, 0.0, 0.002, 0.0035))  # two pairs of the same elevation number share an image

    def image_of(scene: Gaussians) -> torch.Tensor:
        return torch.view_as_real(render_covariances(scene, [VIEW], GRID, stack))

    expected, found = (differentiated(_cloud(60), dtype, image_of) for dtype in (torch.float64, torch.float32))
    check_agreement(found, expected)


# ---- as few images: the engine's cross-sections of pairs, and pairs that share an image ------------------------------
VIEWS = [View(20.0, 35.0), View(200.0, 55.0)]
COARSE = ImageGrid(12, 10, (0.4, 0.5), (0.6, 0.7))


@pytest.mark.parametrize(
    ("count", "pairs", "shared", "imaginary"), [(1, 1, True, False), (50, 3, True, False), (33, 2, False, True)]
)
def test_cross_sections_of_pairs_and_gradients_are_those_of_plain_torch(count, pairs, shared, imaginary):
    g = torch.Generator().manual_seed(count)
    v = len(VIEWS)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=g)

    leaves = {
        "means": 3 * normal(count, 3),
        "quaternions": normal(count, 4),
        "scales": 0.1 + 0.5 * normal(count, 3).abs(),
        "roots": normal(v, count, 3).abs() + 0.3,
        "real": normal(v, count, 1 if shared else pairs),
        **({"imaginary": normal(v, count, pairs)} if imaginary else {}),
    }
    constants = {
        "frames": torch.from_numpy(np.stack([radar_frame(view) for view in VIEWS])),
        "numbers": normal(v, pairs),
    }
    constants["numbers"][0, 0] = 0.0
    cotangents = normal(v, count, 2 * pairs), normal(v, count, 2)
    found = []
    for new_pass, dtype in ((cpu.Pass, torch.float32), (None, torch.float64)):
        own = {name: each.to(dtype).requires_grad_() for name, each in leaves.items()}
        named = own | {name: each.to(dtype) for name, each in constants.items()}
        outputs = Sections().on(new_pass, *(named.get(name) for name in Sections.names))
        gradients = torch.autograd.grad(outputs, list(own.values()), [each.to(dtype) for each in cotangents])
        found.append([*outputs, *gradients])
    for own, true in zip(*found, strict=True):
        assert float((own.double() - true).detach().norm()) <= 2e-6 * float(true.detach().norm())


def in_cells(polarimetric: bool) -> Gaussians:
    law = Polarimetric(torch.randn(40, 10, generator=torch.Generator().manual_seed(0))) if polarimetric else None
    flat = cloud(40, 0, size=(6.0, 6.0, 6.0), scale=0.2, degree=0)
    return replace(flat, scattering=law or flat.scattering)


@pytest.mark.parametrize("polarimetric", [False, True])
def test_even_passes_share_images_and_others_do_not(polarimetric):
    names = ("HH", "HV", "VV") if polarimetric else ("",)

    def stack(passes: tuple[float, ...]) -> Stack:
        offsets = tuple(offset for offset in passes for _ in names)
        return Stack(0.031, offsets, polarisations=names * len(passes) if polarimetric else None)

    even, uneven = stack((-0.002, 0.0, 0.002)), stack((-0.002, 0.0007, 0.002))
    of_even, of_uneven = (lit_planes(in_cells(polarimetric), VIEWS, COARSE, [one] * 2)[0] for one in (even, uneven))
    assert len(set(of_even.of_pairs)) < len(set(of_uneven.of_pairs)) <= len(of_uneven.of_pairs)
    assert of_even.powers.shape[1] == len(names)
    for pair in ((0, len(names)), (len(names), 2 * len(names))):  # alone, each has an image of its own
        alone = Stack(
            0.031,
            tuple(even.offsets_rad[i] for i in pair),
            polarisations=tuple(even.of_channels[i] for i in pair) if polarimetric else None,
        )
        whole = render_covariances(in_cells(polarimetric), VIEWS, COARSE, even)
        expected = render_covariances(in_cells(polarimetric), VIEWS, COARSE, alone)
        between = whole[:, pair[0], pair[1]] - expected[:, 0, 1]
        assert float(between.abs().max()) < 1e-4 * float(whole.abs().max())
