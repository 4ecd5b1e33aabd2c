"""What a report shows of interferometric stacks: two passes, and a slice through layover."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from made import dataset_of
from sarsplat import ImageGrid, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack, write_report
from sarsplat.data import Dataset, write_dataset
from sarsplat.geometry import radar_frame
from sarsplat.report.layover import Slice, brightest_layover
from sarsplat.report.stacks import Interferogram, Pair, averaged, covariances

VIEW, GRID = View(0.0, 45.0), ImageGrid(24, 20, (0.5, 0.6), (0.6, 0.6))
OFFSETS = (0.0, 0.0006, 0.0012, 0.0024, 0.0048)
STACK = Stack(0.031, OFFSETS, noise=(0.05,) * 5)


def dataset(views: tuple[View, ...] = (VIEW,)) -> Dataset:
    """A block of 4 × 6 × 5 m."""
    block = trimesh.creation.box((4.0, 6.0, 5.0))
    block.apply_translation((0.0, 0.0, 2.5))
    law = ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0)
    signals = [simulate_stack(block, view, GRID, STACK, law, ground_gamma0=0.5, noise=0.05) for view in views]
    seen = [(view, "train") for view in views]
    return dataset_of(GRID, seen, np.stack(signals), stack=STACK, looks=1.0, ground=True, target="block")


@pytest.mark.parametrize("height_m", [3.0, 8.0, 20.0, 1000.0])
def test_the_pair_is_the_longest_whose_phase_turns_at_most_once(height_m: float) -> None:
    pair = Pair.longest(STACK, VIEW, height_m)
    assert OFFSETS[pair.first] > OFFSETS[pair.second]  # what is higher has more phase
    cycle_m = 0.5**0.5 * 0.031 / 2 / (OFFSETS[pair.first] - OFFSETS[pair.second])
    assert pair.cycle_m == pytest.approx(cycle_m, rel=1e-4)
    baselines = sorted({round(a - b, 6) for a in OFFSETS for b in OFFSETS if a > b})
    at_most = 0.5**0.5 * 0.031 / 2 / height_m
    longest = max((one for one in baselines if one <= at_most), default=baselines[0])
    assert OFFSETS[pair.first] - OFFSETS[pair.second] == pytest.approx(longest)


@pytest.mark.parametrize("height_m", [-1.0, 0.0, 2.5])
def test_a_plane_is_coherent_and_its_phase_is_that_of_its_height(height_m: float) -> None:
    """Up to the edges."""
    pair = Pair.longest(STACK, VIEW, 6.0)
    rng = np.random.default_rng(0)
    speckle = rng.normal(size=(24, 20)) + 1j * rng.normal(size=(24, 20))
    signals = speckle * np.exp(1j * STACK.plane_phases(VIEW, GRID, height_m))
    shown = Interferogram.of(averaged(pair.of(covariances(signals), STACK.plane_phases(VIEW, GRID)), 3))
    np.testing.assert_allclose(shown.coherence, 1.0, rtol=1e-6)
    np.testing.assert_allclose(shown.phase, 2 * math.pi * height_m / pair.cycle_m, atol=1e-3)


def test_what_is_not_coherent_looks_so() -> None:
    rng = np.random.default_rng(0)
    signals = rng.normal(size=(5, 24, 20)) + 1j * rng.normal(size=(5, 24, 20))
    parts = Pair(1, 0, 10.0).of(covariances(signals), np.zeros((5, 24, 20)))
    assert Interferogram.of(averaged(parts, 3)).coherence.mean() < 0.4
    assert Interferogram.of(averaged(parts, 11)).coherence.mean() < 0.15
    assert not Interferogram.of(0 * parts).coherence.any()


def test_the_slice_is_where_layover_is_bright() -> None:
    """Not where power is brightest: there, all points of a pixel have one height."""
    signals = np.ones((2, 5, 24, 20), np.complex64)
    signals[..., 3], signals[1, ..., 14] = 10.0, 3.0
    images = dataset_of(GRID, [(View(90.0, 45.0), "train"), (VIEW, "train")], signals, stack=STACK, looks=1.0)
    wall = [(GRID.azimuth_m[c], e, 0.0) for c in (7, 14) for e in (0.0, 1.1 * STACK.resolution_m)]
    ground = [(azimuth, 0.0, 1.0) for azimuth in GRID.azimuth_m]
    index, cut = brightest_layover(images, np.array(wall + ground) @ radar_frame(VIEW), 3)
    assert (index, cut.view) == (1, VIEW)
    assert abs(cut.azimuth_m - GRID.azimuth_m[14]) < 1.1 * 0.5  # the window of three columns holds it
    assert cut.thickness_m == pytest.approx(1.5)
    _, none = brightest_layover(images, np.array(ground) @ radar_frame(VIEW), 3)
    assert abs(none.azimuth_m - GRID.azimuth_m[3]) < 1.1 * 0.5


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 215.0])
def test_a_slice_lies_along_the_line_of_sight(azimuth: float) -> None:
    view = View(azimuth, 30.0)
    cut = Slice(view, 2.0, 1.0)
    local = np.array([[2.0, 0.0, 0.0], [2.4, 3.0, 0.0], [2.6, 3.0, 0.0], [2.0, 0.0, 4.0]])
    points = local @ radar_frame(view)
    assert cut.within(points).tolist() == [True, True, False, True]
    ranges, heights = cut.axes(points)
    assert ranges[3] - ranges[0] == pytest.approx(4 * math.cos(math.radians(30)))  # farther away
    assert heights[3] - heights[0] == pytest.approx(-2.0)
    lines = cut.through(trimesh.creation.box((50.0, 50.0, 2.0)))
    np.testing.assert_allclose(lines @ radar_frame(view)[0], 2.0, atol=1e-9)
    assert np.abs(lines[..., 2]).max() == pytest.approx(1.0)


def test_the_page_shows_phase_coherence_and_a_slice(tmp_path) -> None:
    block = trimesh.creation.box((4.0, 6.0, 5.0))
    data = write_dataset(tmp_path / "data", dataset(), truth_mesh=block)
    run = reconstruct(data, replace(preset("stack"), iterations=15), quiet=True)
    text = re.sub(r"base64,[A-Za-z0-9+/=]+", "", write_report(run, tmp_path / "page.html", quiet=True).read_text())
    for words in (
        *("<h2>Phase and coherence</h2>", "<h2>Slice through the layover</h2>", "mean of all 5 passes"),
        *("true surface", "m of height", "ground range, m</span>", "height z, m</span>", "Capon&#39;s method, "),
    ):
        assert words in text, words
    for name in ("measured", "rendered"):
        for what in ("power", "phase", "coherence"):
            assert f'alt="{name}: {what}"' in text
    assert text.count('class="outline true"') >= 2 * 4  # a box, beside both clouds
    pictures = text[text.index("Phase and coherence") : text.index("Slice through")]
    assert pictures.count('class="line second"') == 1  # where it is cut


@pytest.mark.filterwarnings("ignore:there is one training view")
def test_the_page_of_a_run_of_power_alone_shows_neither(tmp_path) -> None:
    few = preset("speckled")
    few = replace(few, iterations=1, fewest_gaussians=10, points=replace(few.points, rays_per_pixel=1.0))
    run = reconstruct(dataset(), few, quiet=True)
    text = write_report(run, tmp_path / "page.html", quiet=True).read_text()
    assert "Phase and coherence" not in text and "Slice through" not in text
