"""Pulses combined before back-projection make the image of all pulses, from a fraction of them."""

import numpy as np
import pytest
from scipy import sparse

from pulses import C
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import TAYLOR
from sarsplat.importers import phase_combining, phase_history
from sarsplat.importers.phase_apertures import whole_flight
from sarsplat.importers.phase_combining import Combined
from sarsplat.importers.phase_history import PhaseHistory, Recorded
from sarsplat.importers.phase_history_images import _edge, focus

POINTS = [((0, 0, 0), 1.0), ((4, -3.5, 0), 1.0), ((-4.5, 4.8, 0), 0.5), ((1.5, 2, 1), 1.0)]
OUTSIDE = [((8, 15, 0), 100.0), ((0, -22, 0), 30.0)]
"""Much brighter, and where an image of too few pulses would show them."""


class InFile(Recorded):
    def __init__(self, samples):
        self.samples = samples

    @property
    def shape(self):
        return self.samples.shape

    def part(self, pulses):
        return InFile(self.samples[:, pulses])

    def read(self):
        return self.samples


def flight(pulses, degrees, distance_m, *, rises_deg=0.0, sways_m=0.0, jitter_m=0.0, gap=False, recorded=False):
    """Past the scene, with a climb, a slow sway, independent errors of its places, or pulses missing."""
    along = np.linspace(-1, 1, pulses)
    azimuth, height = np.radians(degrees / 2 * along), np.radians(35 + rises_deg * along**2)
    level = np.cos(height)
    antenna = distance_m * np.stack([np.cos(azimuth) * level, -np.sin(azimuth) * level, np.sin(height)], axis=1)
    random = np.random.default_rng(0)
    antenna += sways_m * np.stack([np.sin(9 * along), np.cos(7 * along), np.sin(11 * along + 1)], axis=1)
    antenna += jitter_m * random.normal(size=antenna.shape)
    if gap:
        antenna = np.delete(antenna, np.r_[pulses // 3 : pulses // 3 + 40, random.integers(0, pulses, 20)], axis=0)
    count = len(antenna)
    first_hz, step_hz = np.full(count, 9.3e9), np.full(count, 2e6)
    reference = np.linalg.norm(antenna - (30, 20, 0), axis=1)  # elsewhere than the middle of the image
    frequencies = first_hz + 2e6 * np.arange(200)[:, None]
    samples = sum(
        amplitude * np.exp(-4j * np.pi / C * frequencies * (np.linalg.norm(antenna - point, axis=1) - reference))
        for point, amplitude in POINTS + OUTSIDE
    ).astype(np.complex64)
    return PhaseHistory("made", first_hz, step_hz, antenna, reference, InFile(samples) if recorded else samples)


FLIGHTS = {
    "from space": dict(pulses=1200, degrees=2, distance_m=7e5),
    "from the air": dict(pulses=1200, degrees=2, distance_m=1e4),
    "the other way": dict(pulses=1200, degrees=-2, distance_m=1e4),
    "wide": dict(pulses=3000, degrees=30, distance_m=5e3),
    "rising": dict(pulses=1200, degrees=3, distance_m=1e4, rises_deg=0.3),
    "swaying": dict(pulses=1200, degrees=2, distance_m=1e4, sways_m=2.0),
    "with gaps": dict(pulses=1200, degrees=2, distance_m=1e4, gap=True),
}


def combined(aperture, grid):
    return Combined.around(aperture.history, aperture.around_m, _edge(aperture, grid), aperture.cross)


@pytest.mark.parametrize("name", FLIGHTS)
def test_makes_the_image_of_all_pulses_from_a_part_of_them(name, monkeypatch):
    aperture = whole_flight(flight(**FLIGHTS[name]), np.zeros(3))
    grid = ImageGrid(13, 10, (1.0, 1.0), aperture.resolution_m(TAYLOR))
    told = []
    image = focus(aperture, grid, TAYLOR, told.append)
    assert len(combined(aperture, grid).kept) < len(aperture.history) / 2
    assert sum(told) == len(aperture.history)
    monkeypatch.setattr(phase_combining, "_WORTH", 0.0)
    assert len(combined(aperture, grid).kept) == len(aperture.history)
    np.testing.assert_allclose(image, focus(aperture, grid, TAYLOR), atol=1e-5 * np.abs(image).max())


def test_pulses_that_others_say_nothing_of_are_all_kept():
    aperture = whole_flight(flight(1200, 2, 1e4, jitter_m=0.01), np.zeros(3))
    grid = ImageGrid(50, 40, (0.25, 0.25), aperture.resolution_m(TAYLOR))
    assert len(combined(aperture, grid).kept) == len(aperture.history)


def test_a_small_image_takes_few_pulses():
    aperture = whole_flight(flight(1200, 2, 1e4), np.zeros(3))
    for side in (1, 3, 6):
        grid = ImageGrid(side, side, (0.25, 0.25), aperture.resolution_m(TAYLOR))
        assert len(combined(aperture, grid).kept) < 20


def test_an_antenna_that_rises_where_it_all_but_stands_still_is_no_reason_to_run_out_of_memory():
    along = np.linspace(-1, 1, 1200)
    places, turns = along**9, np.stack([1e3 * along, -1e3 * along], axis=1)
    kept, weights = phase_combining._few(places, turns)
    assert len(kept) == 1200
    assert (weights != sparse.eye_array(1200)).nnz == 0


def test_reads_piece_by_piece_what_it_would_read_at_once(monkeypatch):
    image = {}
    for recorded in (False, True):
        aperture = whole_flight(flight(1200, 2, 7e5, recorded=recorded), np.zeros(3))
        monkeypatch.setattr(phase_history, "_AT_A_TIME", 7 * 200)
        image[recorded] = focus(aperture, ImageGrid(20, 20, (0.25, 0.25), aperture.resolution_m(TAYLOR)), TAYLOR)
    np.testing.assert_allclose(image[True], image[False], atol=1e-6 * np.abs(image[False]).max())
