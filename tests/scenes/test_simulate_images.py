"""Simulated images and stacks, from either source of truth, on several views at once."""

import math
import threading
import time
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import trimesh

from made import upright
from sarsplat import ImageGrid, Stack, View, radar_frame, render_covariances
from sarsplat.geometry.responses import TAYLOR
from sarsplat.names import Simulator
from sarsplat.scenes import Mechanisms, ScatteringLaw, add_speckle, paper_grid, simulate_raycast, simulate_stack
from sarsplat.scenes._parallel import in_order
from sarsplat.scenes.mechanisms import MATRICES
from sarsplat.scenes.meshes import scaled
from sarsplat.scenes.raycast import default_ray_spacing
from sarsplat.scenes.simulate import simulate_images

GRID = ImageGrid(36, 36, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
VIEWS = [View(20.0, 45.0), View(140.0, 30.0)]
BOX = trimesh.creation.box(extents=(6.0, 3.6, 2.0)).apply_translation((0, 0, 1.0))


def test_both_sources_show_the_same_target_also_twenty_times_as_large() -> None:
    """β⁰ has no length in it, and pieces and rays follow from the pixels."""
    large_grid = ImageGrid(36, 36, spacing_m=(6.0, 6.0), resolution_m=(6.0, 6.0))
    counts, found = list[float](), []
    for source in get_args(Simulator):
        images = simulate_images(BOX, VIEWS, GRID, source=source, progress=counts.append)
        large = simulate_images(scaled(BOX, 20.0), VIEWS, large_grid, source=source)
        assert (images.shape, images.dtype) == ((2, 36, 36), np.float32)
        np.testing.assert_allclose(large, images, rtol=1e-3, atol=1e-4 * images.max())
        found.append(images)
    assert [count for count in counts if count % 1 == 0] == [1, 2, 1, 2]  # and shares, if an image takes its time
    rays, splats = found
    np.testing.assert_allclose(splats.sum(axis=(1, 2)), rays.sum(axis=(1, 2)), rtol=0.02)
    assert np.corrcoef(np.sqrt(rays).ravel(), np.sqrt(splats).ravel())[0, 1] > 0.999


def test_rays_follow_from_the_resolution_but_miss_no_small_target() -> None:
    assert default_ray_spacing(BOX, paper_grid()) == 0.02
    assert default_ray_spacing(scaled(BOX, 0.01), paper_grid()) == pytest.approx(0.0006)
    speck = scaled(BOX, 0.003)  # 18 mm × 11 mm × 6 mm, in cells of 0.3 m
    wide = replace(GRID, resolution_m=(0.6, 0.6))  # at resolution = spacing the pixel lattice would ripple
    image = simulate_images(speck, VIEWS[:1], wide, law=ScatteringLaw(1.0, 0.0))[0]
    area = np.abs(speck.face_normals @ VIEWS[0].direction) @ speck.area_faces / 2  # projected, of a convex body
    assert image.sum() * 0.3**2 == pytest.approx(area, rel=0.02)


# ---- speckle ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("looks", [1, 4, 2.5])
def test_speckle_keeps_the_mean_and_has_variance_one_over_looks(looks):
    power = np.full((400, 400), 3.0, dtype=np.float32)
    speckled = add_speckle(power, looks, np.random.default_rng(0))
    assert speckled.dtype == np.float32 and speckled.shape == power.shape
    assert speckled.mean() == pytest.approx(3.0, rel=0.02)
    assert speckled.var() == pytest.approx(9.0 / looks, rel=0.04)
    np.testing.assert_allclose(add_speckle(10 * power, looks, np.random.default_rng(0)), 10 * speckled, rtol=1e-6)


# ---- stacks: power of the ray caster, phases of geometry, V of mechanisms --------------------------------------------
VIEW, FINE = View(0.0, 45.0), ImageGrid(40, 36, (0.5, 0.5), (0.7, 0.7))
STACK, LAW = Stack(0.031, (0.0, 0.0004, 0.001)), ScatteringLaw(1.0, 0.0, 1.0)


TALL = trimesh.creation.box((4.0, 6.0, 5.0)).apply_translation((0.0, 0.0, 2.5))


def drawn(mesh: trimesh.Trimesh, count: int, stack: Stack = STACK, grid: ImageGrid = FINE, **settings) -> np.ndarray:
    """Signals of several seeds."""
    settings = {"spacing_m": 0.14, **settings}
    return np.stack([simulate_stack(mesh, VIEW, grid, stack, LAW, seed=k, **settings) for k in range(count)])


def test_power_is_that_of_the_ray_caster() -> None:
    """Means over draws, and over blocks of pixels."""
    grid = ImageGrid(30, 28, (0.5, 0.6), (0.7, 0.8), response=TAYLOR)
    powers = (np.abs(drawn(TALL, 24, grid=grid, ground_gamma0=0.4)) ** 2).mean(0)
    expected = simulate_raycast(TALL, VIEW, grid, LAW, ground_gamma0=0.4)
    for power in powers:
        blocks = [image[:28, :28].reshape(7, 4, 7, 4).mean((1, 3)) for image in (power, expected)]
        assert np.abs(blocks[0] - blocks[1]).max() < 0.3 * expected.max()
        assert power.mean() == pytest.approx(expected.mean(), rel=0.05)


@pytest.mark.filterwarnings("ignore:.*of the target's surface is below the ground")
def test_phases_are_those_of_heights() -> None:
    """Flat ground has none once it is deramped; its coherence is the response's."""
    signals = drawn(trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation((0, 0, -5)), 8, ground_gamma0=1.0)
    deramped = signals * np.exp(-1j * STACK.plane_phases(VIEW, FINE))
    for n in (1, 2):
        pair = (deramped[:, n] * deramped[:, 0].conj()).mean()
        coherence = pair / np.sqrt((np.abs(deramped[:, n]) ** 2).mean() * (np.abs(deramped[:, 0]) ** 2).mean())
        kappa = STACK.elevation_numbers(VIEW)[n] - STACK.elevation_numbers(VIEW)[0]
        blurred = math.exp(-0.5 * (kappa * math.tan(math.radians(45))) ** 2 * FINE.response_variance_m2[1])
        assert np.angle(coherence) == pytest.approx(0, abs=0.02)
        assert abs(coherence) == pytest.approx(blurred, abs=0.02)


@pytest.mark.parametrize("transmit", ["each", "one"])
@pytest.mark.parametrize("view", [View(70.0, 30.0), View(200.0, 55.0)])
def test_signs_are_those_of_distances_from_the_antennas(view: View, transmit: str) -> None:
    """As docs/concepts/stacks.md draws them: simulated signals, rendered covariances and distances agree in sign."""
    stack = Stack(0.031, (0.0, 0.0007), transmit)
    per_metre = (4 if transmit == "each" else 2) * math.pi / 0.031
    level, up = stack.plane_phases(view, FINE), radar_frame(view)[1]
    far = 1e6  # m
    antennas = [far * (view.direction + offset * up) for offset in stack.offsets_rad]
    assert antennas[1][2] > antennas[0][2]  # a positive offset: seen higher
    for height in (-3.0, 2.0, 5.0):
        place = np.array([0.0, 0.0, height])
        below = place - height / math.cos(math.radians(view.grazing_deg)) * up  # on the plane, at the same range
        assert below[2] == pytest.approx(0)
        farther = [math.dist(antenna, place) - math.dist(antenna, below) for antenna in antennas]
        expected = -per_metre * (farther[1] - farther[0])
        assert math.copysign(1, expected) == math.copysign(1, height)
        plate = trimesh.creation.box((3.0, 3.0, 0.01)).apply_translation(place)
        signals = simulate_stack(plate, view, FINE, stack, LAW)
        flat = upright(place, [0.8, 0.8, 0.01], 4.0)
        for pair in (signals[1] * signals[0].conj(), render_covariances(flat, [view], FINE, stack)[0, 1, 0].numpy()):
            deramped = (pair * np.exp(-1j * (level[1] - level[0]))).sum()
            assert np.angle(deramped) == pytest.approx(expected, abs=0.03)


def test_noise_is_in_each_pass_alone_and_seeds_say_all() -> None:
    far = TALL.copy().apply_translation((500.0, 0, 0))
    found = simulate_stack(far, VIEW, FINE, STACK, LAW, noise=0.3)
    assert (np.abs(found) ** 2).mean() == pytest.approx(0.3, rel=0.1)
    assert abs((found[0] * found[1].conj()).mean()) < 0.03
    again = [simulate_stack(TALL, VIEW, FINE, STACK, LAW, noise=0.1, seed=seed) for seed in (3, 3, 4)]
    assert np.array_equal(again[0], again[1])
    assert not np.array_equal(again[0], again[2])


def test_polarisations_go_together_as_their_mechanisms_say() -> None:
    """Means over draws, of the top, the sides and the ground; each of the passes has all polarisations."""
    names = ("HH", "HV", "VV")
    plate = trimesh.creation.box((40.0, 40.0, 0.01))
    stack = Stack(0.031, (0.0,) * 3 + (0.0004,) * 3, polarisations=names * 2)
    beta0 = simulate_raycast(plate, VIEW, FINE, LAW).mean()
    for mechanism, matrix in enumerate(MATRICES):
        signals = drawn(plate, 3, stack, mechanisms=Mechanisms(np.full(len(plate.faces), mechanism)))
        found = np.einsum("kirc,kjrc->ij", signals, signals.conj()) / signals[:, 0].size
        expected = beta0 * matrix
        for first in (slice(0, 3), slice(3, 6)):
            assert np.linalg.norm(found[first, first] - expected) < 0.12 * np.linalg.norm(expected)
        assert np.angle(found[3, 0]) == pytest.approx(np.angle(found[5, 2]), abs=0.1)  # the pass's, not theirs


def test_mechanisms_by_slope() -> None:
    made = trimesh.creation.icosphere(3)
    kinds = Mechanisms.by_slope(made).of_faces
    upward = np.abs(made.face_normals[:, 2])
    assert (kinds[upward > 0.95] == 0).all()
    assert (kinds[upward < 0.05] == 1).all()
    assert (kinds[np.abs(upward - 0.5) < 0.3] == 2).all()
    assert np.trace(MATRICES, axis1=1, axis2=2) == pytest.approx([3] * 3)


# ---- several views at once: order, progress and its end --------------------------------------------------------------
@pytest.fixture(params=[1, 3])
def workers(request, threads):
    threads(request.param)
    return request.param


def test_results_come_in_order_with_progress_within_each(workers):
    shares = []

    def work(item, report):
        for step in range(4):
            report(step / 4)
            time.sleep(0.15 if item == 0 else 0.01)
        return item**2

    assert list(in_order(work, range(5), shares.append)) == [0, 1, 4, 9, 16]
    assert shares == sorted(shares) and any(share % 1 for share in shares) and max(shares) < 5


def test_an_error_or_ctrl_c_ends_the_others(workers):
    begun, ended, waits = threading.Event(), [], [0]

    def work(item, report):
        if item == 0:
            raise KeyboardInterrupt
        begun.set()
        try:
            for _ in range(1000):
                report(0.5)
                waits[0] += 1
                time.sleep(0.01)
        finally:
            ended.append(item)

    with pytest.raises(KeyboardInterrupt):
        list(in_order(work, range(10)))
    assert waits[0] < 200  # two seconds of the ten that one takes to its end, however busy the machine
    assert len(ended) <= workers
