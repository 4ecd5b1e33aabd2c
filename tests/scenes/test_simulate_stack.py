"""Simulated stacks: their power is the ray caster's, their phases their geometry's, V that of their mechanisms."""

import math

import numpy as np
import pytest
import trimesh

from made import upright
from sarsplat import View, render_covariances
from sarsplat.geometry import ImageGrid, Stack, radar_frame
from sarsplat.geometry.responses import TAYLOR
from sarsplat.scenes import Mechanisms, ScatteringLaw, simulate_raycast, simulate_stack
from sarsplat.scenes.mechanisms import MATRICES

VIEW, GRID = View(0.0, 45.0), ImageGrid(40, 36, (0.5, 0.5), (0.7, 0.7))
STACK, LAW = Stack(0.031, (0.0, 0.0004, 0.001)), ScatteringLaw(1.0, 0.0, 1.0)


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((4.0, 6.0, 5.0)).apply_translation((0.0, 0.0, 2.5))


def drawn(mesh: trimesh.Trimesh, count: int, stack: Stack = STACK, grid: ImageGrid = GRID, **settings) -> np.ndarray:
    """Signals of several seeds."""
    settings = {"spacing_m": 0.14, **settings}
    return np.stack([simulate_stack(mesh, VIEW, grid, stack, LAW, seed=k, **settings) for k in range(count)])


@pytest.mark.parametrize("grid", [GRID, ImageGrid(30, 28, (0.5, 0.6), (0.7, 0.8), response=TAYLOR)])
def test_power_is_that_of_the_ray_caster(grid: ImageGrid) -> None:
    """Means over draws, and over blocks of pixels."""
    powers = (np.abs(drawn(box(), 24, grid=grid, ground_gamma0=0.4)) ** 2).mean(0)
    expected = simulate_raycast(box(), VIEW, grid, LAW, ground_gamma0=0.4)
    for power in powers:
        blocks = [image[:28, :28].reshape(7, 4, 7, 4).mean((1, 3)) for image in (power, expected)]
        assert np.abs(blocks[0] - blocks[1]).max() < 0.3 * expected.max()
        assert power.mean() == pytest.approx(expected.mean(), rel=0.05)


@pytest.mark.filterwarnings("ignore:.*of the target's surface is below the ground")
def test_phases_are_those_of_heights() -> None:
    """Flat ground has none once it is deramped; its coherence is the response's."""
    signals = drawn(trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation((0, 0, -5)), 8, ground_gamma0=1.0)
    deramped = signals * np.exp(-1j * STACK.plane_phases(VIEW, GRID))
    for n in (1, 2):
        pair = (deramped[:, n] * deramped[:, 0].conj()).mean()
        coherence = pair / np.sqrt((np.abs(deramped[:, n]) ** 2).mean() * (np.abs(deramped[:, 0]) ** 2).mean())
        kappa = STACK.elevation_numbers(VIEW)[n] - STACK.elevation_numbers(VIEW)[0]
        blurred = math.exp(-0.5 * (kappa * math.tan(math.radians(45))) ** 2 * GRID.response_variance_m2[1])
        assert np.angle(coherence) == pytest.approx(0, abs=0.02)
        assert abs(coherence) == pytest.approx(blurred, abs=0.02)


@pytest.mark.parametrize("transmit", ["each", "one"])
@pytest.mark.parametrize("view", [View(70.0, 30.0), View(200.0, 55.0)])
def test_signs_are_those_of_distances_from_the_antennas(view: View, transmit: str) -> None:
    """As docs/concepts/stacks.md draws them: simulated signals, rendered covariances and distances agree in sign."""
    stack = Stack(0.031, (0.0, 0.0007), transmit)
    per_metre = (4 if transmit == "each" else 2) * math.pi / 0.031
    level, up = stack.plane_phases(view, GRID), radar_frame(view)[1]
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
        signals = simulate_stack(plate, view, GRID, stack, LAW)
        flat = upright(place, [0.8, 0.8, 0.01], 4.0)
        for pair in (signals[1] * signals[0].conj(), render_covariances(flat, [view], GRID, stack)[0, 1, 0].numpy()):
            deramped = (pair * np.exp(-1j * (level[1] - level[0]))).sum()
            assert np.angle(deramped) == pytest.approx(expected, abs=0.03)


def test_noise_is_in_each_pass_alone_and_seeds_say_all() -> None:
    far = box().apply_translation((500.0, 0, 0))
    found = simulate_stack(far, VIEW, GRID, STACK, LAW, noise=0.3)
    assert (np.abs(found) ** 2).mean() == pytest.approx(0.3, rel=0.1)
    assert abs((found[0] * found[1].conj()).mean()) < 0.03
    again = [simulate_stack(box(), VIEW, GRID, STACK, LAW, noise=0.1, seed=seed) for seed in (3, 3, 4)]
    assert np.array_equal(again[0], again[1])
    assert not np.array_equal(again[0], again[2])


def test_polarisations_go_together_as_their_mechanisms_say() -> None:
    """Means over draws, of the top, the sides and the ground; each of the passes has all polarisations."""
    names = ("HH", "HV", "VV")
    plate = trimesh.creation.box((40.0, 40.0, 0.01))
    stack = Stack(0.031, (0.0,) * 3 + (0.0004,) * 3, polarisations=names * 2)
    beta0 = simulate_raycast(plate, VIEW, GRID, LAW).mean()
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
    for matrix in MATRICES:
        assert np.trace(matrix).real == pytest.approx(3)
