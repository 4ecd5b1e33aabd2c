"""Complex files and a table of passes become stacks: the same signals, the same signs, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from made_imports import GRID, NOISY, THREE, VIEWS, import_passes, import_pictures, write_passes
from sarsplat import Mechanisms, ScatteringLaw, simulate_stack
from sarsplat.cli import main
from sarsplat.data import read_dataset
from sarsplat.geometry import ImageGrid, Stack, View, radar_frame
from sarsplat.importers import MeasuredImage, dataset_of

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # of few views, for instance

STACK = Stack(0.031, (0.0, 0.0007, -0.0011), noise=(0.1,) * 3)
POLARISED = Stack(0.031, (0.0,) * 3, noise=(0.1,) * 3, polarisations=("HH", "HV", "VV"))
LAW = ScatteringLaw(1.0, 0.0, 1.0)


@pytest.mark.parametrize("column", ["baseline", "polarisation"])
def test_simulated_stacks_come_back(tmp_path, column):
    mesh = trimesh.creation.box((2.0, 3.0, 2.0)).apply_translation((0, 0, 1.0))
    stack, mechanisms = (STACK, None) if column == "baseline" else (POLARISED, Mechanisms(np.zeros(12, np.int64)))
    options = {"ground_gamma0": 0.5, "noise": 0.1, "mechanisms": mechanisms}
    signals = [simulate_stack(mesh, view, GRID, stack, LAW, **options) for view in VIEWS]
    cells = stack.offsets_rad if column == "baseline" else stack.of_channels
    made = import_passes(write_passes(tmp_path / "in", np.stack(signals), {column: list(cells)}), noise=0.1)
    np.testing.assert_array_equal(made.signal, np.stack(signals))
    assert (made.views, made.grid, made.stacks) == (VIEWS, GRID, (stack, stack))
    assert [entry.name for entry in made.entries] == ["v0", "v1"]
    assert read_dataset(tmp_path / "out").fingerprint() == made.fingerprint()


@pytest.mark.parametrize("transmit", ["each", "one"])
@pytest.mark.parametrize("conjugate", [False, True])
@pytest.mark.parametrize("flattened", [False, True])
def test_phases_between_passes_are_those_of_heights(tmp_path, transmit, conjugate, flattened):
    """Of one scatterer, recorded as its distances from the antennas say."""
    height, view, far = 3.0, VIEWS[1], 1e6
    grid = replace(GRID, center_m=(0.0, 0.0))
    per_metre = (4 if transmit == "each" else 2) * math.pi / 0.031
    antennas = [far * (view.direction + offset * radar_frame(view)[1]) for offset in STACK.offsets_rad]
    place = np.array([0.4, -0.3, height])
    azimuth, _, away = radar_frame(view) @ place
    response = np.exp(-2 * np.subtract.outer(grid.range_m, [away]) ** 2 / 0.5**2)
    response = response * np.exp(-2 * (grid.azimuth_m - azimuth) ** 2 / 0.6**2)
    signals = []
    for antenna in antennas:
        farther = math.dist(antenna, place) - math.dist(antenna, np.zeros(3))
        level = np.zeros(response.shape)
        if flattened:
            for row, column in np.ndindex(level.shape):  # on the plane z = 0, seen in this pixel
                slant, sine = grid.range_m[row], math.sin(math.radians(view.grazing_deg))
                rise = slant * sine / math.cos(math.radians(view.grazing_deg))
                ground = np.array([grid.azimuth_m[column], rise, slant]) @ radar_frame(view)
                level[row, column] = math.dist(antenna, ground) - math.dist(antenna, np.zeros(3))
        signals.append(response * np.exp(-1j * per_metre * (farther - level)))
    signal = np.stack(signals).astype(np.complex64)
    folder = write_passes(
        tmp_path / "in", [signal.conj() if conjugate else signal], {"baseline": list(STACK.offsets_rad)}, views=[view]
    )
    made = import_passes(folder, transmit=transmit, conjugate=conjugate, flattened=flattened)
    [stack] = made.stacks
    deramped = made.signal[0] * np.exp(-1j * stack.plane_phases(view, made.grid))
    numbers = stack.elevation_numbers(view)
    peak = np.unravel_index(made.power[0].argmax(), made.power[0].shape)
    on_plane = replace(grid, rows=1, columns=1, center_m=(azimuth, away))
    for n in (1, 2):
        k_z = (numbers[n] - numbers[0]) / math.cos(math.radians(view.grazing_deg))
        assert math.copysign(1, k_z) == math.copysign(1, STACK.offsets_rad[n])
        pair = deramped[n][peak] * deramped[0][peak].conj()
        # the scatterer is not in the middle of its pixel, along which the phase of the plane changes
        within = np.subtract(stack.plane_phases(view, on_plane)[:, 0, 0], stack.plane_phases(view, grid)[:, *peak])
        assert np.angle(pair * np.exp(-1j * (within[n] - within[0]))) == pytest.approx(k_z * height, abs=2e-3)


def test_relative_power_and_noise_have_one_unit(tmp_path):
    folder = write_passes(tmp_path / "in", 3 * NOISY, {"baseline": [0.0, 1e-3, 2e-3]})
    made = import_passes(folder, calibration="relative", noise=0.9)
    assert made.power.mean() == pytest.approx(1, rel=1e-5)
    assert made.stacks[0].noise == pytest.approx([0.9 / made.source["mean_power"]] * 3)


def test_polarisations_come_back(tmp_path):
    names = ["HH", "hv", "VV"]
    folder = write_passes(tmp_path / "in", NOISY, {"pol": names})
    made = import_passes(folder)
    np.testing.assert_array_equal(made.signal, NOISY)
    assert made.stacks[0] == Stack(0.031, (0.0,) * 3, polarisations=("HH", "HV", "VV"))
    assert made.polarimetric and not made.interferometric
    both = write_passes(tmp_path / "in", NOISY[:, :2], {"polarisation": ["HH", "HH"], "baseline": [0.0, 1e-3]})
    assert import_passes(both).interferometric


def test_stacks_lie_as_single_images_do(tmp_path):
    turned = np.rot90(NOISY, 2, axes=(2, 3))[..., ::-1]
    folder = write_passes(tmp_path / "in", turned, {"baseline": [0.0, 1e-3, 2e-3]})
    np.testing.assert_array_equal(import_passes(folder, near="bottom", mirrored=True).signal, NOISY)


def test_rows_with_views_of_their_own_are_single_images_as_before(tmp_path):
    folder = write_passes(tmp_path / "in", NOISY[:, :1], {"polarisation": ["HH"]})
    made = import_pictures(folder, quantity=None)
    assert (made.passes, made.signal.shape) == (0, (2, 20, 16))


def test_stacks_of_other_spacings_keep_the_phases_of_the_plane():
    """A steep ramp would leave the band that is interpolated."""
    stack, view = Stack(0.031, (0.0, 0.008)), View(0.0, 30.0)
    coarse, fine = (ImageGrid(n, n, (s, s), (0.7, 0.7)) for n, s in ((40, 0.5), (48, 0.4)))
    images = []
    for name, grid in (("coarse", coarse), ("fine", fine)):
        signal = np.exp(1j * stack.plane_phases(view, grid)).astype(np.complex64)
        images.append(MeasuredImage(name, signal, view, grid.spacing_m, grid.resolution_m, stack=stack))
    made = dataset_of(images, target="plane", source={}, calibration="absolute")
    np.testing.assert_allclose(made.signal[0][:, 15:-15, 15:-15], made.signal[1][:, 15:-15, 15:-15], atol=2e-3)


def test_the_command_says_how_phases_were_read(tmp_path, capsys):
    folder, out = write_passes(tmp_path / "in", NOISY, THREE), tmp_path / "out"
    words = ["import", "stack", str(folder), "--spacing", "0.5", "0.4", "--out", str(out)]
    words += ["--wavelength", "0.031", "--transmit", "one", "--noise", "0.2"]
    assert main([*words, "--conjugate", "--flattened"]) == 0
    told = capsys.readouterr().out
    assert "assumed: what is farther away has more phase in the files" in told
    assert "assumed: the phases of the level plane z = 0 were taken out of the files" in told
    assert "2 views of 3 channels, 8 m × 8 m, largest gap 290°, ready" in told
    assert read_dataset(out).stacks[0].transmit == "one"
    assert main([*words, "--overwrite", "--baseline", "1"]) == 2
    capsys.readouterr()
    assert main(["reconstruct", str(out), "--iterations", "2", "--out", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "next: " in told and "sarsplat evaluate" in told
